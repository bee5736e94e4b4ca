# SPDX-License-Identifier: Apache-2.0
"""Pictures of a desk with a world marker on it and a wand over it, as a webcam would take them.

Everything is a flat textured quad, drawn far ones first through the camera's own lens: every pixel
knows its ray (`Lens.rays`), so the distortion needs no second resampling. There is no liquid in
these pictures; that is for the overlay to add.
"""

from typing import NamedTuple

import cv2
import numpy as np

from sph_ros.core.jit import bare_kernel
from sph_ros.render.lens import Lens
from sph_ros.render.optics import LAMP
from sph_ros.tracking.detection import get_dictionary, marker_picture

#: Ids of the printed pages, see `sph_ros markers`, and the side of their black squares [m].
WORLD_ID, WAND_ID, MARKER_SIZE = 0, 1, 0.08

#: White paper around a marker, as a share of its side: the frame to cut along on the printed page.
MARGIN = 0.2

#: Texels per metre of what lies on the desk, and of markers.
DESK_TEXELS, MARKER_TEXELS = 900, 2500

#: Standard deviation of the noise of a pixel, of 255, and of the blur [pixels].
NOISE, DEFOCUS = 2.5, 0.5

_FINE = 2  # samples along a pixel's edge


class Quad(NamedTuple):
    """A textured parallelogram: `origin` is the texture's upper left corner [m], (3,)."""

    origin: np.ndarray
    along: np.ndarray  # the texture's upper edge [m], (3,)
    down: np.ndarray  # its left edge [m], (3,)
    texture: tuple  # of `_mipmaps`
    shade: float = 1.0  # below 1, the texture says how much of what is behind is darkened to this


class Desk:
    """A desk and the camera over it.

    Args:
        camera: CameraModel with its size.
        seed: of wood grain and noise; equal seeds take equal pictures.
    """

    def __init__(self, camera, seed=0):
        self._random = np.random.default_rng(seed)
        self._size = camera.width, camera.height
        self._rays = Lens(camera).rays(_FINE)
        self._still = [*self._furniture(), self._world_page()]
        self._card = _mipmaps(_card_picture(WAND_ID, 1.0 + 2.0 * MARGIN))
        self._back = _mipmaps(np.full((8, 8, 3), (150, 195, 215), np.float32))
        self._stick = _mipmaps(_stick_picture())

    def take(self, camera_from_world, world_from_wand):
        """A picture (H, W, 3) uint8 BGR.

        Args:
            camera_from_world: Pose.
            world_from_wand: Pose of the marker on the wand's card.
        """
        width, height = self._size
        picture = np.empty((_FINE * height, _FINE * width, 3), np.float32)
        picture[:] = (196, 205, 208)
        eye = camera_from_world.inverse().position
        quads = [*self._still, *self._shadow(world_from_wand)]
        for quad in (*quads, *self._wand(world_from_wand, eye)):
            _draw(picture, quad, camera_from_world, self._rays)
        picture = cv2.resize(picture, self._size, interpolation=cv2.INTER_AREA)
        picture = cv2.GaussianBlur(picture, (0, 0), DEFOCUS)
        picture *= _vignette(self._size)[..., None]
        picture += NOISE * self._random.standard_normal(picture.shape, dtype=np.float32)
        return np.clip(picture + 0.5, 0, 255).astype(np.uint8)

    # ---------------------------------------------------------------- what stands still

    def _furniture(self):
        """Wall, wooden desk, a book, a mug and pencils, far ones first."""
        wall = np.full((32, 64, 3), (188, 198, 200), np.float32)
        wall[24:] *= np.linspace(1.0, 0.86, 8)[:, None, None]
        yield _quad((-1.5, 0.75, 1.0), (3.0, 0, 0), (0, 0, -1.0), wall)
        yield _quad((-0.9, 0.75, 0.0), (1.8, 0, 0), (0, -1.5, 0), self._wood(1.8, 1.5))
        yield from self._book((-0.42, 0.16), (0.21, 0.15), 0.03, (120, 70, 40))
        yield from _mug((0.27, 0.22), 0.04, 0.095, (70, 110, 190))
        for x, y, dx, dy, colour in (
            (-0.24, -0.075, 0.165, 0.035, (40, 60, 200)),
            (0.145, -0.13, 0.03, 0.17, (60, 140, 50)),
        ):
            yield from _pencil((x, y), (dx, dy), colour)

    def _wood(self, width, depth):
        """Boards along x with a grain, (H, W, 3) float32 BGR."""
        rows, columns = int(depth * DESK_TEXELS), int(width * DESK_TEXELS)
        picture = np.empty((rows, columns, 3), np.float32)
        board = int(0.14 * DESK_TEXELS)
        for top in range(0, rows, board):
            tone = self._random.uniform(0.92, 1.06)
            fine = self._noise((board, columns), (3, 160))
            broad = self._noise((board, columns), (25, 700))
            grain = tone + 0.05 * fine + 0.07 * np.sin(6.0 * broad)
            grain[:2] *= 0.72  # the joint
            picture[top : top + board] = (grain[..., None] * (104, 148, 186))[: rows - top]
        return picture

    def _noise(self, shape, scale):
        """Smooth noise of deviation one whose features measure `scale` texels."""
        coarse = [max(2, int(np.ceil(n / s)) + 1) for n, s in zip(shape, scale, strict=True)]
        coarse = self._random.standard_normal(coarse, dtype=np.float32)
        return cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC)

    def _book(self, corner, size, height, colour):
        """A closed book: its cover, its front and its right side."""
        (x, y), (width, depth) = corner, size
        cover = np.full((150, 210, 3), colour, np.uint8)
        cover[18:132, 16:194] = np.multiply(colour, 1.18)
        cv2.putText(cover, "WAVES", (46, 72), cv2.FONT_HERSHEY_TRIPLEX, 1.1, (210, 225, 235), 2)
        cv2.line(cover, (50, 92), (160, 92), (210, 225, 235), 2)
        pages = np.full((30, 60, 3), (205, 220, 228), np.float32)
        pages[::3] *= 0.9
        pages[:3], pages[-3:] = colour, colour
        yield _shadow_blob((x - 0.02, y - 0.03), (width + 0.04, depth + 0.05), 0.7)
        yield _quad((x, y, height), (width, 0, 0), (0, 0, -height), 0.75 * pages)
        yield _quad((x + width, y, height), (0, depth, 0), (0, 0, -height), 0.9 * pages)
        yield _quad((x, y + depth, height), (width, 0, 0), (0, -depth, 0), cover)

    def _world_page(self):
        """A sheet of paper with the world marker in its middle."""
        card = _card_picture(WORLD_ID, 2.2).astype(np.uint8)
        side = 2.2 * MARKER_SIZE
        note = "DICT_4X4_50 id 0, 80 mm: the world"
        place = (int(0.2 * card.shape[0]), int(0.93 * card.shape[0]))
        cv2.putText(card, note, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (90, 90, 90), 1, cv2.LINE_AA)
        return _quad((-side / 2, side / 2, 0.0), (side, 0, 0), (0, -side, 0), card)

    # ---------------------------------------------------------------- what moves

    def _wand(self, pose, eye):
        """The card and its stick, which goes up out of the picture."""
        half = 0.5 * MARKER_SIZE * (1.0 + 2.0 * MARGIN)
        x, y = pose.rotation[:, 0], pose.rotation[:, 1]
        corner = pose.position + half * (y - x)
        stick = Quad(
            pose.position + 0.45 * y - 0.006 * x - 0.002 * pose.rotation[:, 2],
            0.012 * x,
            -(0.45 + 0.8 * half) * y,
            self._stick,
        )
        front = float(pose.rotation[:, 2] @ (eye - pose.position)) > 0.0
        card = Quad(corner, 2 * half * x, -2 * half * y, self._card if front else self._back)
        return [stick, card] if front else [card, stick]

    def _shadow(self, pose):
        """The card's shadow on the desk, by the lamp of all our pictures."""
        half = 0.5 * MARKER_SIZE * (1.0 + 2.0 * MARGIN)
        x, y = half * pose.rotation[:, 0], half * pose.rotation[:, 1]
        corners = pose.position + np.array([y - x, y + x, -y - x])
        fallen = corners - np.outer(corners[:, 2] / LAMP[2], LAMP)
        along, down = fallen[1] - fallen[0], fallen[2] - fallen[0]
        soft = _soft_square()
        margin = 0.25  # of the soft square around the dark one
        origin = fallen[0] - margin * (along + down)
        scale = 1.0 + 2.0 * margin
        yield Quad(origin, scale * along, scale * down, _mipmaps(soft), 0.72)


# ---------------------------------------------------------------- textures


def _card_picture(marker_id, side):
    """A marker on white paper whose side is `side` times the marker's, (H, W, 3) float32 BGR."""
    pixels = int(MARKER_SIZE * MARKER_TEXELS)
    marker = marker_picture(get_dictionary("DICT_4X4_50"), marker_id, pixels)
    border = round(0.5 * (side - 1.0) * pixels)
    page = np.pad(marker.astype(np.float32), border, constant_values=255.0)
    return cv2.merge([0.855 * page + 12, 0.865 * page + 12, 0.87 * page + 12])


def _stick_picture():
    """A round wooden stick, (H, W, 3) float32 BGR."""
    across = np.sqrt(1.0 - np.linspace(-0.95, 0.95, 16) ** 2)
    light = (0.55 + 0.45 * across)[None, :, None]
    return np.tile(light * (140.0, 190.0, 225.0), (64, 1, 1)).astype(np.float32)


def _soft_square():
    """1 where a shadow is, (H, W, 3) float32; half as large as the picture."""
    square = np.zeros((90, 90, 3), np.float32)
    square[15:-15, 15:-15] = 1.0
    return cv2.GaussianBlur(square, (0, 0), 6.0)


def _quad(origin, along, down, picture):
    return Quad(*(np.array(v, float) for v in (origin, along, down)), _mipmaps(picture))


def _shadow_blob(corner, size, shade):
    """A soft shadow on the desk around what stands there."""
    origin = (corner[0] - 0.02, corner[1] + size[1] + 0.02, 0.0)
    along, down = (size[0] + 0.04, 0, 0), (0, -size[1] - 0.04, 0)
    return _quad(origin, along, down, _soft_square())._replace(shade=shade)


def _mug(centre, radius, height, colour, sides=22):
    """A mug as upright strips and the dark of its inside."""
    yield _shadow_blob((centre[0] - 0.065, centre[1] - 0.045), (0.11, 0.1), 0.7)
    angles = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1) * radius + centre
    order = np.argsort(-ring[:-1, 1])
    for number in order:
        a, b = ring[number], ring[number + 1]
        normal = (0.5 * (a + b) - centre) / radius
        light = 0.55 + 0.5 * max(float(normal @ LAMP[:2]) + 0.25, 0.0)
        behind = normal[1] > 0.15
        texture = np.full((2, 2, 3), colour, np.float32) * (0.45 if behind else light)
        yield _quad((*a, height), (*(b - a), 0), (0, 0, -height), texture)


def _pencil(start, way, colour):
    """A pencil that lies on the desk: two faces and a wooden tip, drawn as one strip."""
    start, way = np.array([*start, 0.004]), np.array([*way, 0.0])
    across = np.array([-way[1], way[0], 0.0])
    across *= 0.009 / np.linalg.norm(across)
    strip = np.full((12, 240, 3), colour, np.float32)
    strip[:5] *= 1.25
    strip[9:] *= 0.65
    strip[:, 214:] = (150, 195, 222)
    strip[:, 234:] = 60
    soft = _soft_square()
    corner = start + 1.4 * across + (-0.004, 0.002, -0.004)
    yield _quad(corner, way, -2.4 * across, soft)._replace(shade=0.45)
    yield _quad(start + across, way, -across, strip)


def _mipmaps(picture):
    """A texture: the picture and halved copies down to some texels.

    Returns:
        levels (L, 3) int64: offset, height and width; texels (N, 3) float32.
    """
    pictures = [np.ascontiguousarray(picture, np.float32)]
    while min(pictures[-1].shape[:2]) >= 8:
        height, width = pictures[-1].shape[:2]
        halved = (width // 2, height // 2)
        pictures.append(cv2.resize(pictures[-1], halved, interpolation=cv2.INTER_AREA))
    sizes = np.array([one.shape[:2] for one in pictures])
    offsets = np.cumsum([0, *sizes.prod(axis=1)])[:-1]
    texels = np.concatenate([one.reshape(-1, 3) for one in pictures])
    return np.column_stack([offsets, sizes]), texels


def _vignette(size):
    """Light that falls off towards the corners, (H, W) float32."""
    x, y = (np.linspace(-1, 1, n, dtype=np.float32) for n in size)
    return 1.0 - 0.10 * (x[None, :] ** 2 + y[:, None] ** 2)


# ---------------------------------------------------------------- drawing


def _draw(picture, quad, camera_from_world, rays):
    """Draw one quad into the fine picture (H, W, 3) float32."""
    inverse = _texture_from_ray(quad, camera_from_world)
    if inverse is not None:
        rows, columns = _region(quad, camera_from_world, rays)
        _draw_quad(rays, inverse, quad.texture, (*rows, *columns), quad.shade, picture)


def _texture_from_ray(quad, camera_from_world):
    """Matrix (3, 3) from a ray (x, y, 1) to texture u w, v w, w with w > 0 before the camera.

    A ray s (x, y, 1) meets the quad where s d = o + u a + v b, so M^-1 d = (u, v, 1) / s for M with
    columns a, b, o.
    """
    origin, along, down = (
        camera_from_world.rotation @ vector for vector in (quad.origin, quad.along, quad.down)
    )
    matrix = np.column_stack([along, down, origin + camera_from_world.position])
    if abs(np.linalg.det(matrix)) < 1e-12:  # seen exactly from the side
        return None
    return np.linalg.inv(matrix).astype(np.float32)


def _region(quad, camera_from_world, rays):
    """Rows and columns of the fine picture that a quad can touch; everything if it is close."""
    corners = quad.origin + np.array(
        [0 * quad.along, quad.along, quad.along + quad.down, quad.down]
    )
    corners = camera_from_world.apply(corners)
    height, width = rays.shape[:2]
    if corners[:, 2].min() < 0.05:
        return (0, height), (0, width)
    x, y = (corners[:, :2] / corners[:, 2:]).T
    middle_row, middle_column = rays[height // 2, :, 0], rays[:, width // 2, 1]
    slack = 0.12  # rays of one column differ by the distortion
    columns = np.searchsorted(middle_row, [x.min() - slack, x.max() + slack])
    rows = np.searchsorted(middle_column, [y.min() - slack, y.max() + slack])
    return rows, columns


@bare_kernel
def _draw_quad(rays, inverse, texture, region, shade, picture):  # the last is written
    """Sample a texture, from the copy whose texels are about as large as pixels, bilinearly.

    Args:
        rays: of all pixels, (H, W, 2).
        inverse: of `_texture_from_ray`, (3, 3).
        texture: levels (L, 3): offset, height and width; and texels (N, 3).
        region: first and last + 1 row, the same of columns.
        shade: below 1, the texture says how much of everything behind is darkened to this.
        picture: (H, W, 3).
    """
    levels, texels = texture
    for row in range(region[0], region[1]):
        last_u, last_v = 0.0, 0.0
        for column in range(region[2], region[3]):
            x, y = rays[row, column, 0], rays[row, column, 1]
            w = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
            if w <= 0.0:
                continue
            u = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]) / w
            v = (inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]) / w
            du, dv = (u - last_u) * levels[0, 2], (v - last_v) * levels[0, 1]
            last_u, last_v = u, v
            if not (0.0 <= u < 1.0 and 0.0 <= v < 1.0):
                continue
            level, square = 0, du * du + dv * dv
            while square > 2.0 and level < len(levels) - 1:
                square *= 0.25
                level += 1
            begin, high, wide = levels[level, 0], levels[level, 1], levels[level, 2]
            i = min(max(v * high - 0.5, 0.0), high - 1.001)
            j = min(max(u * wide - 0.5, 0.0), wide - 1.001)
            a, b = i - int(i), j - int(j)
            at = begin + int(i) * wide + int(j)
            for k in range(3):
                value = (1.0 - a) * ((1.0 - b) * texels[at, k] + b * texels[at + 1, k]) + a * (
                    (1.0 - b) * texels[at + wide, k] + b * texels[at + wide + 1, k]
                )
                if shade < 1.0:
                    picture[row, column, k] *= 1.0 - (1.0 - shade) * value
                else:
                    picture[row, column, k] = value
