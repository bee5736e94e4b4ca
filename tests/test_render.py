# SPDX-License-Identifier: Apache-2.0
"""Pictures show things where they are, before what they hide, and water as optics has it."""

import numpy as np
import pytest

from sph_ros.render import Camera, Frame, SolidView, render, save_png
from sph_ros.render.light_map import floor_light
from sph_ros.render.optics import WATER_INDEX, fresnel, reflect, refract
from sph_ros.render.picture import _draw_liquid
from sph_ros.render.plots import plot_history
from sph_ros.render.video import VideoWriter
from sph_ros.render.walls import convex_planes

SIZE = (160, 120)
NO_PARTICLES = np.zeros((0, 3), np.float32)


def sphere_mesh(radius, rings=24, sectors=48):
    """Vertices (V, 3) and triangles (T, 3) of a sphere around 0, outward."""
    theta = np.linspace(0, np.pi, rings + 1)[:, None]
    phi = np.linspace(0, 2 * np.pi, sectors, endpoint=False)[None]
    parts = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi]
    triangles = []
    for i in range(rings):
        for j in range(sectors):
            a, b = i * sectors + j, i * sectors + (j + 1) % sectors
            triangles += [[a, a + sectors, b], [b, a + sectors, b + sectors]]
    return radius * np.stack(parts, -1).reshape(-1, 3), np.array(triangles)


def box_mesh(lower, upper):
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))]
    lower, upper = np.asarray(lower), np.asarray(upper)
    return lower + corners * (upper - lower), np.array(triangles)


def ball(name, position, radius=0.1, color=(1.0, 0.0, 0.0)):
    return SolidView(name, *sphere_mesh(radius), position=position, color=color)


def redness(picture):
    return picture[..., 0].astype(int) - np.maximum(picture[..., 1], picture[..., 2])


def green(picture):
    return picture[..., 1].astype(int) - np.maximum(picture[..., 0], picture[..., 2])


@pytest.mark.nojit
def test_fresnel_limits():
    """2 % at normal incidence (n = 1.333), all at grazing, total beyond 48.6 degrees inside."""
    assert fresnel(1.0, WATER_INDEX) == pytest.approx((0.333 / 2.333) ** 2)
    assert fresnel(0.0, WATER_INDEX) == pytest.approx(1.0)
    shares = [fresnel(c, WATER_INDEX) for c in np.linspace(1.0, 0.0, 50)]
    assert np.all(np.diff(shares) > -1e-9)
    critical = np.arcsin(1.0 / WATER_INDEX)
    assert fresnel(np.cos(critical + 1e-3), 1.0 / WATER_INDEX) == 1.0
    assert fresnel(np.cos(critical - 0.05), 1.0 / WATER_INDEX) < 0.5


@pytest.mark.nojit
def test_snell_and_mirror():
    incoming = np.radians(40.0)
    bent = refract(np.sin(incoming), 0.0, -np.cos(incoming), 0.0, 0.0, 1.0, WATER_INDEX)
    assert bent[0] == pytest.approx(np.sin(incoming) / WATER_INDEX)
    assert bent[2] == pytest.approx(-np.sqrt(1 - bent[0] ** 2))
    assert reflect(0.6, 0.0, -0.8, 0.0, 0.0, 1.0) == pytest.approx((0.6, 0.0, 0.8))
    steep = refract(0.9, 0.0, -np.sqrt(1 - 0.81), 0.0, 0.0, 1.0, 1.0 / WATER_INDEX)
    assert steep[2] > 0.0  # total reflection


def test_ball_is_drawn_where_the_camera_projects_it():
    camera = Camera.look_at((1.1, -1.7, 0.9), (0.1, 0.1, 0.0))
    frame = Frame(NO_PARTICLES, solids=[ball("ball", (0.2, 0.3, 0.1))], floor_z=-1.0)
    mask = redness(render(frame, camera, (320, 240))) > 40
    rows, columns = np.nonzero(mask)
    (where,), (depth,) = camera.project([[0.2, 0.3, 0.1]], (320, 240))
    assert np.hypot(columns.mean() + 0.5 - where[0], rows.mean() + 0.5 - where[1]) < 1.0
    focal = camera.intrinsics((320, 240))[0]
    radius = focal * 0.1 / np.sqrt(depth**2 - 0.1**2)
    assert np.sqrt(mask.sum() / np.pi) == pytest.approx(radius, rel=0.03)


@pytest.mark.nojit
def test_up_is_up_and_right_is_right():
    camera = Camera.look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0))
    image, depth = camera.project([[0.3, 0.0, 0.2]], SIZE)
    assert image[0, 0] > SIZE[0] / 2 and image[0, 1] < SIZE[1] / 2
    assert depth == pytest.approx(2.0)


def test_fit_shows_the_whole_box_and_fills_the_picture():
    lower, upper = np.array([-0.2, 0.1, 0.0]), np.array([0.5, 0.4, 0.6])
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    for elevation, azimuth in ((5, 0), (30, -60), (80, 170)):
        camera = Camera.fit(lower, upper, elevation, azimuth, aspect=4 / 3)
        image, _ = camera.project(lower + corners * (upper - lower), SIZE)
        assert image.min() >= 0.0 and np.all(image.max(axis=0) <= SIZE)
        assert (np.ptp(image, axis=0) / SIZE).max() > 0.6


@pytest.mark.parametrize("near_first", [True, False])
def test_near_hides_far_whatever_the_order(near_first):
    camera = Camera.look_at((0.0, -2.0, 0.3), (0.0, 0.0, 0.0))
    near = ball("near", (0.0, -0.5, 0.05))
    far = ball("far", (0.0, 0.5, 0.0), 0.3, (0.0, 1.0, 0.0))
    solids = [near, far] if near_first else [far, near]
    picture = render(Frame(NO_PARTICLES, solids=solids, floor_z=-1.0), camera, SIZE)
    (where,), _ = camera.project([[0.0, -0.5, 0.05]], SIZE)
    x, y = where.astype(int)
    assert redness(picture)[y, x] > 40
    assert (green(picture) > 40).sum() > 200


def test_triangles_share_their_edges_and_are_clipped_at_the_eye():
    """A floor of triangles that runs under the camera covers each pixel once, without a crack."""
    vertices = np.array([[-5.0, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0], [0.123, 0.0456, 0]])
    triangles = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    floor = SolidView("floor", vertices, triangles, color=(1.0, 0.0, 0.0))
    camera = Camera.look_at((0.1, -1.0, 0.4), (0.1, -0.6, 0.0), 50.0)
    picture = render(Frame(NO_PARTICLES, solids=[floor], floor_z=-1.0), camera, SIZE, 1)
    assert redness(picture).min() > 20


def drop_of_water(radius=0.08, centre=(0.0, 0.0, 0.2)):
    vertices, triangles = sphere_mesh(radius, 48, 96)
    normals = (vertices / radius).astype(np.float32)
    return (vertices + centre).astype(np.float32), triangles.astype(np.int32), normals


def test_thickness_of_a_sphere_is_its_chord():
    camera = Camera.look_at((0.0, -3.0, 0.2), (0.0, 0.0, 0.2), 5.0)
    size = (200, 200)
    open_air = np.full(size[::-1], np.inf, np.float32)
    front, back, thickness = _draw_liquid(drop_of_water(), camera, size, open_air)
    focal = camera.intrinsics(size)[0]
    x, y = np.meshgrid(np.arange(200) + 0.5 - 100, np.arange(200) + 0.5 - 100)
    aside = np.hypot(x, y) / focal * 3.0
    chord = 2.0 * np.sqrt(np.maximum(0.08**2 - aside**2, 0.0))
    inner = aside < 0.07
    assert np.abs(thickness - chord)[inner].max() < 0.003
    assert np.abs(thickness[aside > 0.082]).max() == 0.0
    assert front[100, 100, 0] == pytest.approx(2.92, abs=1e-3)
    assert back[100, 100, 0] == pytest.approx(3.08, abs=1e-3)
    assert front[100, 100, 1:] == pytest.approx([0, -1, 0], abs=0.02)
    wall = np.full(size[::-1], 3.0, np.float32)
    behind = _draw_liquid(drop_of_water(), camera, size, wall)
    assert behind[2][100, 100] == pytest.approx(0.08, abs=1e-3)  # ends at the solid inside
    assert behind[1][100, 100, 0] == 0.0


def test_background_is_seen_through_water():
    """The tiles under the water show through it, bent and less red."""
    camera = Camera.look_at((0.2, 0.2, 1.5), (0.2, 0.2, 0.0), 20.0)
    vertices, triangles = box_mesh([0, 0, 0], [0.4, 0.4, 0.1])
    up = np.tile(np.float32([0, 0, 1]), (8, 1))
    particles = vertices.astype(np.float32)
    wet = render(Frame(particles, None, (vertices, triangles, up), [], 0.01, 0.0), camera, SIZE)
    dry = render(Frame(particles, None, tuple(a[:0] for a in (up, triangles, up))), camera, SIZE)
    inner = (slice(40, 80), slice(55, 105))
    wet_blue, dry_blue = wet[inner][..., 2].astype(float), dry[inner][..., 2].astype(float)
    assert wet_blue.std() > 0.5 * dry_blue.std() > 5.0  # the tiles' contrast survives
    assert wet[inner][..., 0].mean() < 0.95 * dry[inner][..., 0].mean()  # red is absorbed most


def test_solid_in_the_water_is_seen_and_is_bluer_when_deeper():
    def red_over_blue(depth):
        camera = Camera.look_at((0.2, 0.2, 1.5), (0.2, 0.2, 0.0), 20.0)
        vertices, triangles = box_mesh([0, 0, 0], [0.4, 0.4, 0.3])
        water = (vertices, triangles, np.tile(np.float32([0, 0, 1]), (8, 1)))
        inside = ball("ball", (0.2, 0.2, 0.3 - depth), 0.06, (1.0, 1.0, 1.0))
        particles = vertices.astype(np.float32)
        picture = render(Frame(particles, None, water, [inside], 0.01, 0.0), camera, SIZE)
        middle = picture[SIZE[1] // 2 - 2 : SIZE[1] // 2 + 2, SIZE[0] // 2 - 2 : SIZE[0] // 2 + 2]
        return middle[..., 0].mean() / middle[..., 2].mean()

    assert red_over_blue(0.2) < red_over_blue(0.1) - 0.05 < red_over_blue(0.0)


def test_flat_water_moves_light_but_makes_none():
    """Refraction only moves the lamp's light: its sum over the floor loses 8 % under water."""
    x, y = np.meshgrid(np.linspace(0, 0.4, 60), np.linspace(0, 0.4, 60), indexing="ij")
    slope = 0.02 * np.cos(40 * x) * 0.4
    vertices = np.stack([x, y, 0.15 + 0.02 * 0.4 / 40 * np.sin(40 * x)], -1).reshape(-1, 3)
    normals = np.stack([-slope, 0 * x, 1 + 0 * x], -1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    corner = (np.arange(59)[:, None] * 60 + np.arange(59)).reshape(-1, 1)
    triangles = np.concatenate([corner + [0, 60, 61], corner + [0, 61, 1]]).astype(np.int32)
    surface = (vertices.astype(np.float32), triangles, normals.astype(np.float32))
    lower, upper = np.zeros(3), np.array([0.4, 0.4, 0.15])
    dark = np.zeros((0, 3, 3))
    light, _, scale = floor_light(surface, dark, NO_PARTICLES, 0.01, 0.0, lower, upper)
    lost = (1.0 - light).sum() / scale**2
    assert lost / 0.16 == pytest.approx(0.08, abs=0.02)
    assert light.max() > 1.03  # waves focus


def test_ball_casts_a_shadow_of_its_size():
    points = ball("ball", (0.0, 0.0, 0.3)).world_vertices()[sphere_mesh(0.1)[1]]
    lower, upper = np.full(3, -0.1), np.array([0.1, 0.1, 0.4])
    light, _, scale = floor_light(None, points, NO_PARTICLES, 0.01, -0.1, lower, upper)
    assert light.min() < 0.05 and light.max() <= 1.0
    area = (1.0 - light).sum() / scale**2
    assert area == pytest.approx(np.pi * 0.1**2 / 0.886, rel=0.03)  # over the lamp's cosine


def test_planes_of_a_box_in_any_pose():
    half_turn = (0, 0, np.sqrt(0.5), np.sqrt(0.5))
    solid = SolidView("tank", *box_mesh([0, 0, 0], [1, 2, 3]), (0.5, 0, 0), half_turn, True)
    planes = convex_planes(solid)
    assert len(planes) == 6
    inside = np.array([-1.0, 0.5, 1.5])  # turned a quarter about z: x in -1.5..0.5, y in 0..1
    assert np.sort(planes[:, 3] - planes[:, :3] @ inside) == pytest.approx(
        [0.5, 0.5, 0.5, 1.5, 1.5, 1.5]
    )
    dented = SolidView("l", *sphere_mesh(1.0), container=True)
    dented.vertices[600] *= 0.5
    assert len(convex_planes(dented)) == 0


def test_particles_are_drawn_in_the_colour_of_their_speed():
    camera = Camera.look_at((0.0, -1.0, 0.0), (0.0, 0.0, 0.0), 30.0)
    particles = np.float32([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]])
    velocities = np.float32([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    picture = render(Frame(particles, velocities, None, [], 0.1, -1.0), camera, SIZE)
    image, _ = camera.project(particles, SIZE)
    slow, fast = (picture[int(y), int(x)].astype(int) for x, y in image)
    assert slow[2] > slow[0] + 60
    assert fast.min() > slow.max() - 20 and fast.min() > 120


def test_container_shows_as_outline_only():
    camera = Camera.fit(np.zeros(3), np.ones(3), aspect=4 / 3)
    tank = SolidView("tank", *box_mesh([0, 0, 0], [1, 1, 1]), container=True)
    with_tank = render(Frame(NO_PARTICLES, solids=[tank], floor_z=0.0), camera, SIZE)
    turned = SolidView(
        "tank",
        tank.vertices,
        tank.triangles,
        (1.0, 0.0, 0.0),
        (0, 0, np.sqrt(0.5), np.sqrt(0.5)),
        container=True,
    )
    again = render(Frame(NO_PARTICLES, solids=[turned], floor_z=0.0), camera, SIZE)
    assert np.abs(with_tank.astype(int) - again).max() <= 60
    image, _ = camera.project([[1.0, 0.0, 1.0], [0.5, 0.5, 0.6]], SIZE)
    assert with_tank[int(image[0, 1]), int(image[0, 0])].max() < 150
    assert with_tank[int(image[1, 1]), int(image[1, 0])].min() > 120


@pytest.mark.parametrize(
    "surface", [None, (NO_PARTICLES, NO_PARTICLES.astype(np.int32), NO_PARTICLES)]
)
def test_nothing_at_all_is_a_picture_too(surface):
    camera = Camera.fit(np.zeros(3), np.ones(3))
    picture = render(Frame(NO_PARTICLES, surface=surface), camera, (64, 36))
    assert picture.shape == (36, 64, 3) and picture.dtype == np.uint8


def test_camera_inside_the_water_gives_a_picture():
    camera = Camera.look_at((0.0, 0.0, 0.2), (1.0, 0.0, 0.1))
    frame = Frame(np.float32([[0, 0, 0.2]]), None, drop_of_water(), [], 0.01, 0.0)
    assert render(frame, camera, SIZE).std() > 0.0


def test_same_frame_gives_the_same_bytes():
    camera = Camera.look_at((0.3, -1.0, 0.5), (0.0, 0.0, 0.2), 20.0)
    frame = Frame(np.float32([[0, 0, 0.2]]), None, drop_of_water(), [ball("b", (0.1, 0.3, 0.2))])
    assert render(frame, camera, SIZE).tobytes() == render(frame, camera, SIZE).tobytes()


def test_unusable_sizes_and_cameras_are_refused():
    with pytest.raises(ValueError, match="size"):
        render(Frame(NO_PARTICLES), Camera.fit(np.zeros(3), np.ones(3)), (0, 10))
    with pytest.raises(ValueError, match="distinct"):
        Camera.look_at((0, 0, 1), (0, 0, 1))
    with pytest.raises(ValueError, match="fov"):
        Camera.look_at((0, 0, 1), (0, 0, 0), 200.0)
    with pytest.raises(ValueError, match="finite"):
        Camera.fit((np.nan, 0, 0), (1, 1, 1))


def test_png_is_read_back_and_leaves_no_other_file(tmp_path):
    import cv2

    picture = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)
    save_png(tmp_path / "picture.png", picture)
    assert np.array_equal(cv2.imread(str(tmp_path / "picture.png"))[:, :, ::-1], picture)
    assert [path.name for path in tmp_path.iterdir()] == ["picture.png"]
    (tmp_path / "other").touch()  # may be read by whoever may read any new file
    assert (tmp_path / "picture.png").stat().st_mode == (tmp_path / "other").stat().st_mode
    with pytest.raises(OSError):
        save_png(tmp_path / "missing" / "picture.png", picture)


def test_video_is_read_back(tmp_path):
    import imageio_ffmpeg

    path = tmp_path / "film.mp4"
    with VideoWriter(path, (65, 49), fps=25) as video:
        for n in range(12):
            video.add(np.full((49, 65, 3), 20 * n, np.uint8))
        assert not path.exists()
    count, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert count == 12
    frames = imageio_ffmpeg.read_frames(str(path))
    about = next(frames)
    assert about["size"] == (64, 48) and about["codec"] == "h264" and about["fps"] == 25
    assert "yuv420p" in about["pix_fmt"]
    greys = [np.frombuffer(data, np.uint8).mean() for data in frames]
    assert greys == pytest.approx(20.0 * np.arange(12), abs=3.0)


def test_video_of_an_error_does_not_exist(tmp_path):
    with pytest.raises(KeyError), VideoWriter(tmp_path / "film.mp4", (64, 48)) as video:
        video.add(np.zeros((48, 64, 3), np.uint8))
        raise KeyError
    assert list(tmp_path.iterdir()) == []
    with (
        pytest.raises(ValueError, match="expected"),
        VideoWriter(tmp_path / "a.mp4", (64, 48)) as v,
    ):
        v.add(np.zeros((48, 60, 3), np.uint8))
    with pytest.raises(ValueError, match="mp4"):
        VideoWriter(tmp_path / "film.avi", (64, 48))
    with pytest.raises(FileNotFoundError), VideoWriter(tmp_path / "no" / "film.mp4", (64, 48)):
        pass


def test_missing_ffmpeg_is_said(tmp_path, monkeypatch):
    import imageio_ffmpeg

    def absent():
        raise RuntimeError("No ffmpeg exe could be found.")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", absent)
    with (
        pytest.raises(RuntimeError, match="needs ffmpeg"),
        VideoWriter(tmp_path / "a.mp4", (64, 48)),
    ):
        pass


def test_history_is_plotted(tmp_path):
    import cv2

    time = np.linspace(0, 1, 50)
    history = {
        "time": time,
        "kinetic_energy": time**2,
        "mean_compression": 0.01 * time,
        "max_compression": 0.02 * time,
        "wrench/ball": np.outer(time, np.arange(6)),
    }
    plot_history(tmp_path / "plot.png", history, "ball_tank")
    assert cv2.imread(str(tmp_path / "plot.png")).std() > 5.0
    assert [path.name for path in tmp_path.iterdir()] == ["plot.png"]
    with pytest.raises(ValueError, match="time"):
        plot_history(tmp_path / "plot.png", {"kinetic_energy": time})
    with pytest.raises(ValueError, match="49 instants"):
        plot_history(tmp_path / "plot.png", {"time": time, "kinetic_energy": time[1:]})
