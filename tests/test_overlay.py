# SPDX-License-Identifier: Apache-2.0
"""Water in a camera's picture lies where lens, pose and optics put it, and nowhere else."""

import cv2
import numpy as np
import pytest
import yaml
from scipy.optimize import brentq

from sph_ros.desk_video import BALL, DeskMotion, desk_camera
from sph_ros.nodes.overlay_liquid import LiquidStates
from sph_ros.nodes.overlay_matching import PATIENCE, Matcher
from sph_ros.render.camera import Camera
from sph_ros.render.desk import Desk
from sph_ros.render.lens import Lens
from sph_ros.render.optics import WATER_INDEX
from sph_ros.render.overlay import Liquid, Overlay
from sph_ros.render.picture import SolidView
from sph_ros.sim.shapes import Box, Sphere, display_mesh
from sph_ros.sim.share import share_folder
from sph_ros.tracking.camera import CameraModel
from sph_ros.tracking.detection import Detector
from sph_ros.tracking.se3 import Pose, exp

SIZE = (320, 240)
SPACING = 0.01
DEPTH = 0.06
CAMERA = CameraModel(*SIZE, [[300, 0, 162], [0, 298, 118], [0, 0, 1]], [-0.2, 0.09, 1e-3, -8e-4, 0])
NONE = np.zeros((0, 3), np.float32)
PLAIN = np.full((*SIZE[::-1], 3), 120, np.uint8)


def view_from(eye, target=(0.0, 0.0, 0.03)):
    """camera_from_world of a camera that looks at a target."""
    view = Camera.look_at(eye, target)
    return Pose(view.world_from_camera, view.eye).inverse()


VIEW = view_from((0.1, -0.4, 0.3))


def still_water(depth=DEPTH, half=0.08):
    """Particles at rest in a tank around the z axis, and the tank."""
    across = np.arange(-half + 0.5 * SPACING, half, SPACING)
    up = np.arange(0.5 * SPACING, depth, SPACING)
    points = np.stack(np.meshgrid(across, across, up), -1).reshape(-1, 3).astype(np.float32)
    mesh = display_mesh(Box(min=(-half, -half, 0), max=(half, half, 2 * depth)))
    return points, SolidView("tank", *mesh, container=True)


def ball(position, radius=0.02, color=(1.0, 0.1, 0.0)):
    return SolidView("ball", *display_mesh(Sphere(radius)), position=position, color=color)


def drawn(view, *solids, points=NONE, picture=PLAIN, camera=CAMERA, **more):
    liquid = Liquid(points, None, SPACING, solids=list(solids), **more)
    return Overlay(camera).draw(picture, view, liquid)


def redness(picture):
    return picture[..., 2].astype(int) - picture[..., :2].max(axis=2)


def centroid(mask):
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()])


# ---------------------------------------------------------------- the lens


@pytest.mark.parametrize(
    "distortion",
    [
        [],
        [-0.16, 0.07, 7e-4, -5e-4, -0.015],
        [0.1, -0.2, 1e-3, -1e-3, 0.05, 0.01, 0.02, 0.003],
        [0.1, -0.2, 1e-3, -1e-3, 0.05, 0.01, 0.02, 3e-3, 0.01, 2e-3, -3e-3, 1e-3, 0.02, -0.03],
    ],
)
def test_lens_is_opencvs_and_rays_are_its_inverse(distortion):
    camera = CameraModel(*SIZE, CAMERA.matrix, distortion)
    lens = Lens(camera)
    points = np.random.default_rng(0).uniform((-0.4, -0.3, 0.8), (0.4, 0.3, 1.4), (300, 3))
    assert np.allclose(lens.project(points), camera.project(points), atol=1e-9)
    rays = lens.rays().reshape(-1, 2)
    back = lens.project(np.column_stack([rays, np.ones(len(rays))]))
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    assert np.abs(back - np.column_stack([x.ravel(), y.ravel()])).max() < 1e-3


def test_what_is_far_outside_is_not_folded_back_into_the_picture():
    """With k1 < 0 alone r (1 + k1 r^2) turns round at r = 1 / sqrt(-3 k1), and OpenCV's with it."""
    camera = CameraModel(*SIZE, CAMERA.matrix, [-0.3, 0, 0, 0, 0])
    point = np.array([[1.9, 0.0, 1.0]])
    assert 0 < camera.project(point)[0, 0] < SIZE[0]
    reach = Lens(camera).project(np.array([[1.0, 0, 1], [1.9, 0, 1], [4.0, 0, 1]]))[:, 0]
    assert SIZE[0] < reach[0] < reach[1] < reach[2]
    assert (drawn(Pose(np.eye(3), np.zeros(3)), ball((1.9, 0, 1)), camera=camera) == PLAIN).all()


# ---------------------------------------------------------------- where things are


def test_nothing_to_draw_leaves_the_picture_alone():
    noise = np.random.default_rng(0).integers(0, 256, PLAIN.shape, np.uint8)
    assert (drawn(VIEW, picture=noise) == noise).all()
    behind = ball((0.1, -0.9, 0.4))
    assert (drawn(VIEW, behind, picture=noise, desk_z=-9.0) == noise).all()


def test_pixels_far_from_the_water_are_the_cameras_own():
    points, tank = still_water()
    noise = np.random.default_rng(0).integers(0, 256, PLAIN.shape, np.uint8)
    result = drawn(VIEW, tank, points=points, picture=noise)
    changed = (result != noise).any(axis=2)
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (0, 0.12)])
    corners[:, :2] *= 0.08
    hull = cv2.convexHull(CAMERA.project(VIEW.apply(corners)).astype(np.float32))
    inside = cv2.fillConvexPoly(np.zeros(SIZE[::-1], np.uint8), hull.astype(np.int32), 1) > 0
    water = inside & (np.arange(SIZE[1])[:, None] > hull[..., 1].mean())
    assert changed[water].mean() > 0.9
    # Shadow and caustics reach beyond the tank, but not to the picture's border.
    near = cv2.dilate(inside.astype(np.uint8), np.ones((61, 61))) > 0
    assert not changed[~near].any() and (~near).mean() > 0.2


def test_a_ball_is_where_the_distorted_lens_shows_it():
    place = np.array([0.17, 0.1, 0.12])
    straight = CameraModel(*SIZE, CAMERA.matrix)
    expected = CAMERA.project(VIEW.apply(place[None]))[0]
    assert np.linalg.norm(expected - straight.project(VIEW.apply(place[None]))[0]) > 3.0
    found = centroid((drawn(VIEW, ball(place, 0.012), desk_z=-9.0) != PLAIN).any(axis=2))
    assert np.linalg.norm(found - expected) < 0.6


def test_pictures_do_not_depend_on_what_was_drawn_before():
    points, tank = still_water()
    overlay = Overlay(CAMERA)
    wet = Liquid(points, np.ones_like(points), SPACING, solids=[tank, ball((0, 0, 0.07))])
    first = overlay.draw(PLAIN, VIEW, wet)
    overlay.draw(PLAIN, view_from((-0.3, 0.1, 0.5)), wet)
    assert (overlay.draw(PLAIN, VIEW, wet) == first).all()
    assert (overlay.draw(PLAIN, VIEW, Liquid(points[:0])) == PLAIN).all()


# ---------------------------------------------------------------- optics


def test_water_lifts_the_desk_as_snell_has_it():
    """A dot on the tank's floor appears where the ray bent at the surface meets it."""
    eye, dot = np.array([0.0, -0.3, 0.35]), np.array([0.01, 0.02, 0.0])
    view = view_from(eye, (0.0, 0.0, 0.0))
    dry = CAMERA.project(view.apply(dot[None]))[0]
    picture = PLAIN.copy()
    cv2.circle(picture, tuple(np.round(4 * dry).astype(int)), 10, (0, 0, 250), -1, shift=2)
    away = dot[:2] - eye[:2]
    distance = np.linalg.norm(away)

    def miss(share):  # where the ray that enters at this share of the way meets the floor
        sine = share * distance / np.hypot(share * distance, eye[2] - DEPTH) / WATER_INDEX
        return share * distance + DEPTH * sine / np.sqrt(1 - sine**2) - distance

    share = brentq(miss, 0.1, 1.0)
    entry = np.array([*(eye[:2] + share * away), DEPTH])
    expected = CAMERA.project(view.apply(entry[None]))[0]
    assert np.linalg.norm(expected - dry) > 8.0
    points, tank = still_water()
    red = redness(drawn(view, tank, points=points, picture=picture)) > 60
    red[: int(expected[1]) - 15] = False  # the mirrors in the walls
    red[int(expected[1]) + 15 :] = False
    assert np.linalg.norm(centroid(red) - expected) < 1.5


def test_water_tints_and_the_ball_is_seen_through_it_or_before_it():
    points, tank = still_water()
    view = view_from((0.0, -0.12, 0.5), (0.0, 0.0, 0.0))
    wet = drawn(view, tank, points=points)
    u, v = CAMERA.project(view.apply(np.array([[0.0, 0.0, DEPTH]])))[0].astype(int)
    blue, _, red = wet[v, u].astype(int)
    assert blue > red + 15
    # The same ball over the water and under it: there its light is tinted, and less red.
    redder = [
        redness(drawn(view, tank, ball((0, 0, z)), points=points)).max() for z in (0.09, 0.022)
    ]
    assert redder[0] > redder[1] + 15 > 60


def test_a_card_hides_the_water_behind_it_and_none_before_it():
    points, tank = still_water()
    upright = Pose(exp(np.array([np.pi / 2, 0, 0])), np.zeros(3)).quat_xyzw
    noise = np.random.default_rng(0).integers(0, 256, PLAIN.shape, np.uint8)
    for y, hides in ((-0.12, True), (0.2, False)):
        card = ((0.0, y, 0.05), upright, 0.08)
        view = view_from((0.0, -0.5, 0.12))
        result = drawn(view, tank, points=points, picture=noise, cards=[card])
        # The middle of the card, or what of the water covers it.
        u, v = CAMERA.project(view.apply(np.array([[0.0, -0.08, 0.04]])))[0].astype(int)
        same = (result == noise)[v - 4 : v + 5, u - 4 : u + 5].all(axis=2)
        assert same.all() if hides else same.mean() < 0.3


def test_a_camera_in_the_water_sees_blue_and_nothing_breaks():
    points, tank = still_water()
    inside = drawn(view_from((0.0, -0.05, 0.03), (0.0, 0.2, 0.03)), tank, points=points)
    assert inside[..., 0].mean() > inside[..., 2].mean() + 10
    for eye in ((0.0, -0.0801, 0.03), (0.0, 0.0, 0.0601), (0.08, 0.08, 0.06), (0, 0, 0.005)):
        drawn(view_from(eye, (0.01, 0.3, 0.02)), tank, ball((0, 0, 0.03)), points=points)


# ---------------------------------------------------------------- the film of a desk


def test_the_desk_shows_both_markers_where_the_truth_has_them():
    camera, motion = desk_camera(), DeskMotion()
    time = 4.0
    view = motion.world_from_camera(time).inverse()
    wand = motion.world_from_wand(time)
    assert np.allclose(wand.apply(BALL), motion.ball(time))
    picture = cv2.cvtColor(Desk(camera).take(view, wand), cv2.COLOR_BGR2GRAY)
    half = 0.04 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    found = {one.id: one.corners for one in Detector("DICT_4X4_50", [0, 1]).detect(picture)}
    assert np.abs(found[0] - camera.project(view.apply(half))).max() < 0.35
    assert np.abs(found[1] - camera.project((view @ wand).apply(half))).max() < 0.35
    scene = yaml.safe_load((share_folder() / "scenes" / "desk_tank.yaml").read_text())
    assert np.allclose(scene["solids"][1]["union"][0]["pose"]["position"], BALL)


# ---------------------------------------------------------------- what belongs together


def pose_at(x):
    return Pose(exp(np.array([0.0, 0.0, x])), np.array([x, 0.0, 0.0]))


MS = 10**6


def test_a_picture_waits_for_its_own_pose_and_the_newest_complete_one_is_drawn():
    matcher = Matcher()
    for number in range(3):
        matcher.add_pose(pose_at(number), 100 * number * MS, 0.1 * number)
        matcher.add_picture(f"picture {number}", 100 * number * MS, 0.0, 0.1 * number)
    matcher.add_picture("without pose", 250 * MS, 0.0, 0.25)
    match = matcher.take(0.25)
    assert match.picture == "picture 2" and match.pose.position[0] == 2.0
    assert matcher.dropped == 2 and matcher.take(0.26) is None
    matcher.add_pose(pose_at(3.0), 300 * MS, 0.3)  # its own pose will never come any more
    match = matcher.take(0.3)
    assert match.picture == "without pose" and match.pose.position[0] == pytest.approx(2.5)
    turned = match.pose.rotation @ [1, 0, 0]
    assert np.arctan2(turned[1], turned[0]) == pytest.approx(2.5)


def test_poses_that_stay_away_hold_nothing_up_for_long():
    matcher = Matcher()
    matcher.add_picture("first", 0, 0.0, 0.0)
    assert matcher.take(0.0).pose is None  # there never was one: it does not wait
    matcher.add_pose(pose_at(0.0), 0, 0.0)
    matcher.add_picture("second", 500 * MS, 0.0, 0.1)
    assert matcher.take(0.1) is None
    match = matcher.take(0.1 + PATIENCE + 0.01)
    assert match.picture == "second" and match.pose is None and match.pose_age < 0.3


@pytest.mark.parametrize("same_clock", [True, False])
def test_the_liquid_of_the_pictures_time_and_delay_is_chosen(same_clock):
    matcher = Matcher(delay=0.05)
    start = 1_000_000 * MS if same_clock else 0
    for number in range(30):  # arrive 20 ms after the time of their stamps
        time = 0.03 * number
        matcher.add_state(number, start + int(1e9 * time), 5.0 + time + 0.02)
    matcher.add_picture("picture", 1_000_000 * MS + 300 * MS, 0.004, 5.304)
    match = matcher.take(6.0)
    expected = 0.35 / 0.03 if same_clock else (0.35 - 0.02) / 0.03
    assert abs(match.state - expected) <= 0.51 and abs(match.state_offset) <= 0.0151


def test_the_spacing_is_measured_from_disordered_particles():
    rng = np.random.default_rng(3)
    points, _ = still_water()
    points += rng.normal(0.0, 0.15 * SPACING, points.shape).astype(np.float32)
    assert LiquidStates()._measured_spacing(points, False) == pytest.approx(SPACING, rel=0.1)
