# SPDX-License-Identifier: Apache-2.0
"""A camera that looks at printed markers, with everything that makes life hard for a tracker.

Markers are drawn in perspective, each with its white margin, far ones first; then come motion blur,
light, occlusion, lens distortion, defocus and noise. The truth is what went in.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from sph_ros.tracking.detection import get_dictionary, marker_picture

#: White margin around a marker, as a share of its side.
MARGIN = 0.2

_TEXTURE_MODULE = 24  # [texels] per module


@dataclass(frozen=True)
class Flaws:
    """What is wrong with the pictures.

    Attributes:
        noise: standard deviation of a pixel's grey value, of 255.
        defocus: standard deviation of the blur [pixels].
        exposure: how long the shutter is open [s], for motion blur.
        light: brightness of white, of 255.
        light_change: share by which the light changes over the pictures.
        light_gradient: share by which the light changes across the picture.
        occlusions: number of dark bars in front of everything.
        false_markers: number of markers with ids that nobody asked for.
    """

    noise: float = 3.0
    defocus: float = 0.6
    exposure: float = 0.0
    light: float = 200.0
    light_change: float = 0.0
    light_gradient: float = 0.2
    occlusions: int = 0
    false_markers: int = 0


class SyntheticCamera:
    """Takes grey pictures of targets.

    Args:
        camera: CameraModel.
        dictionary: of the markers.
        flaws: Flaws.
        seed: of noise, occlusions, false markers; equal seeds take equal pictures.
    """

    def __init__(self, camera, dictionary="DICT_4X4_50", flaws=Flaws(), seed=0):  # noqa: B008
        self._camera = camera
        self._dictionary = get_dictionary(dictionary)
        self._flaws = flaws
        self._random = np.random.default_rng(seed)
        self._textures = {}
        self._maps = _distortion_maps(camera)
        self._background = self._make_background()

    def take(self, placed, time=0.0):
        """One picture (H, W) uint8.

        Args:
            placed: [(Target, camera_from_target)]; for motion blur with a function to the Pose
                from a share of the exposure, 0 to 1.
            time: [s], for the change of light.
        """
        flaws = self._flaws
        shares = [0.5] if flaws.exposure <= 0.0 else [0.1, 0.3, 0.5, 0.7, 0.9]
        exposures = [self._draw(placed, share) for share in shares]
        picture = np.mean(exposures, axis=0) if len(exposures) > 1 else exposures[0]
        self._occlude(picture)
        picture = cv2.remap(picture, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if flaws.defocus > 0.0:
            picture = cv2.GaussianBlur(picture, (0, 0), flaws.defocus)
        change = 1.0 + flaws.light_change * np.sin(2.0 * np.pi * 0.7 * time)
        picture = picture * (flaws.light / 255.0 * change) * self._gradient()
        picture += flaws.noise * self._random.standard_normal(picture.shape, dtype=np.float32)
        return np.clip(picture + 0.5, 0, 255).astype(np.uint8)

    def _draw(self, placed, share):
        """Markers in ideal perspective, (H, W) float32, before the lens."""
        picture = self._background.copy()
        quads = []
        for target, pose in placed:
            pose = pose(share) if callable(pose) else pose
            for marker_id in target.ids:
                camera_from_marker = pose @ target.marker_pose(marker_id)
                if _faces_camera(camera_from_marker):
                    size = target.marker_size(marker_id)
                    quads.append(
                        (camera_from_marker.position[2], marker_id, camera_from_marker, size)
                    )
        for _, marker_id, pose, size in sorted(quads, key=lambda quad: -quad[0]):
            self._draw_marker(picture, marker_id, pose, size)
        return picture

    def _draw_marker(self, picture, marker_id, pose, size):
        texture = self._texture(marker_id)
        half = 0.5 * size * (1.0 + 2.0 * MARGIN)
        corners = half * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], float)
        in_camera = pose.apply(corners)
        if in_camera[:, 2].min() < 0.01:
            return
        pixels = in_camera[:, :2] / in_camera[:, 2:] @ self._camera.matrix[:2, :2].T
        pixels = (pixels + self._camera.matrix[:2, 2]).astype(np.float32)
        _warp_into(picture, texture, pixels)

    def _texture(self, marker_id):
        if marker_id not in self._textures:
            modules = self._dictionary.markerSize + 2
            pixels = modules * _TEXTURE_MODULE
            margin = round(MARGIN * pixels)
            marker = marker_picture(self._dictionary, marker_id, pixels)
            self._textures[marker_id] = np.pad(marker, margin, constant_values=255)
        return self._textures[marker_id]

    def _make_background(self):
        """A soft clutter, with false markers where asked for."""
        height, width = self._camera.height, self._camera.width
        coarse = self._random.uniform(90, 200, (height // 40 + 2, width // 40 + 2))
        picture = cv2.resize(
            coarse.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC
        )
        for number in range(self._flaws.false_markers):
            marker_id = len(self._dictionary.bytesList) - 1 - number
            centre = self._random.uniform(0.15, 0.85, 2) * (width, height)
            angle = self._random.uniform(0, 2 * np.pi) + np.pi / 2 * np.arange(4)
            quad = centre + 45.0 * np.column_stack([np.cos(angle), np.sin(angle)])
            _warp_into(picture, self._texture(marker_id), quad.astype(np.float32))
        return picture

    def _occlude(self, picture):
        height, width = picture.shape
        for _ in range(self._flaws.occlusions):
            centre = self._random.uniform(0, 1, 2) * (width, height)
            box = (
                tuple(map(float, centre)),
                (0.6 * width, 0.04 * width),
                float(self._random.uniform(0, 180)),
            )
            cv2.fillConvexPoly(picture, cv2.boxPoints(box).astype(np.int32), 60.0)

    def _gradient(self):
        width = self._camera.width
        return 1.0 + self._flaws.light_gradient * np.linspace(-0.5, 0.5, width, dtype=np.float32)


def _faces_camera(pose):
    return float(pose.rotation[:, 2] @ pose.position) < 0.0


def _warp_into(picture, texture, quad):
    """Draw a square texture onto a quadrilateral, smoothly also where it gets much smaller.

    Args:
        picture: (H, W) float32, changed.
        texture: (T, T) uint8.
        quad: pixels (4, 2) of its corners from top left, clockwise.
    """
    height, width = picture.shape
    low = np.maximum(np.floor(quad.min(axis=0)) - 2, 0).astype(int)
    high = np.minimum(np.ceil(quad.max(axis=0)) + 3, (width, height)).astype(int)
    if (high <= low).any():
        return
    scale = 4  # sub-pixels along each side
    # The texture's edge is half a texel outside its first pixel's centre, and so is a sub-pixel's.
    side = texture.shape[0] - 0.5
    source = np.array([[-0.5, -0.5], [side, -0.5], [side, side], [-0.5, side]], np.float32)
    target = ((quad - low + 0.5) * scale - 0.5).astype(np.float32)
    transform = cv2.getPerspectiveTransform(source, target)
    size = tuple(int(n) * scale for n in high - low)
    texels = float(np.linalg.norm(quad[0] - quad[1]) * scale)
    if texels < 0.5 * texture.shape[0]:  # else most texels would be skipped, not averaged
        texture = cv2.GaussianBlur(texture, (0, 0), 0.4 * texture.shape[0] / max(texels, 1.0))
    drawn = cv2.warpPerspective(texture, transform, size, flags=cv2.INTER_LINEAR)
    mask = cv2.warpPerspective(np.full_like(texture, 255), transform, size, flags=cv2.INTER_LINEAR)
    shape = tuple(int(n) for n in high - low)
    drawn = cv2.resize(drawn.astype(np.float32), shape, interpolation=cv2.INTER_AREA)
    cover = cv2.resize(mask.astype(np.float32), shape, interpolation=cv2.INTER_AREA) / 255.0
    part = picture[low[1] : high[1], low[0] : high[0]]
    part *= 1.0 - cover
    part += drawn


def _distortion_maps(camera):
    """For each pixel of the picture, where it comes from without distortion."""
    height, width = camera.height, camera.width
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
    if len(camera.distortion) == 0:
        return grid[..., 0], grid[..., 1]
    ideal = cv2.undistortPoints(
        grid.reshape(-1, 1, 2), camera.matrix, camera.distortion, P=camera.matrix
    )
    ideal = ideal.reshape(height, width, 2).astype(np.float32)
    return np.ascontiguousarray(ideal[..., 0]), np.ascontiguousarray(ideal[..., 1])
