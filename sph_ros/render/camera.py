# SPDX-License-Identifier: Apache-2.0
"""A pinhole camera in the world, z up."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Camera:
    """Where the picture is taken from.

    The camera's frame is the optical one: x right, y down, z forward. Image coordinates are
    continuous: the picture's upper left corner is (0, 0), the first pixel's centre (0.5, 0.5).

    Attributes:
        eye: position [m], world frame, (3,).
        world_from_camera: rotation, columns are right, down and forward in the world, (3, 3).
        fov: vertical angle of view [deg].
    """

    eye: np.ndarray
    world_from_camera: np.ndarray
    fov: float = 40.0

    @classmethod
    def look_at(cls, eye, target, fov=40.0) -> "Camera":
        """Camera at `eye` that looks at `target`, upright.

        Raises:
            ValueError: eye and target at one place or not finite, fov not in 1 to 170 degrees.
        """
        eye, target = np.asarray(eye, np.float64), np.asarray(target, np.float64)
        forward = target - eye
        distance = np.linalg.norm(forward)
        if not (np.isfinite(distance) and distance > 0.0):
            raise ValueError(f"camera: eye {eye} and target {target}, expected two distinct points")
        if not 1.0 <= fov <= 170.0:
            raise ValueError(f"fov: {fov}, expected 1 to 170 degrees")
        forward /= distance
        up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        return cls(eye, np.stack([right, np.cross(forward, right), forward], axis=1), float(fov))

    @classmethod
    def fit(
        cls, lower, upper, elevation=24.0, azimuth=-62.0, fov=32.0, aspect=16 / 9, margin=1.12
    ) -> "Camera":
        """Camera from which the box between `lower` and `upper` [m] just fills the picture.

        Args:
            lower: corner of the box [m], (3,).
            upper: opposite corner [m], (3,).
            elevation: angle above the horizon from which the box is seen [deg].
            azimuth: direction of the camera from the box, from x towards y [deg].
            fov: vertical angle of view [deg].
            aspect: width over height of the picture.
            margin: more than 1 leaves room around the box.

        Raises:
            ValueError: corners not finite.
        """
        lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
        if not (np.isfinite(lower).all() and np.isfinite(upper).all()):
            raise ValueError(f"camera: box {lower} to {upper}, expected finite corners")
        a, e = np.radians([azimuth, elevation])
        towards = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
        centre = 0.5 * (lower + upper)
        size = max(np.linalg.norm(upper - lower), 1e-3)
        camera = cls.look_at(centre + size * towards, centre, fov)
        corners = np.array(np.meshgrid(*zip(lower, upper, strict=True))).reshape(3, -1).T
        x, y, z = ((corners - centre) @ camera.world_from_camera).T
        half_height = np.tan(np.radians(fov) / 2) / margin
        distance = np.maximum(np.abs(x) / (half_height * aspect), np.abs(y) / half_height) - z
        return cls.look_at(centre + max(distance.max(), 0.1 * size) * towards, centre, fov)

    def intrinsics(self, size) -> tuple[float, float, float]:
        """Focal length and principal point (f, cx, cy) [pixels] for size (width, height)."""
        width, height = size
        return 0.5 * height / np.tan(np.radians(self.fov) / 2), 0.5 * width, 0.5 * height

    def to_camera(self, points) -> np.ndarray:
        """World points [m] in the camera's frame, (N, 3) float32."""
        return ((np.asarray(points, np.float64) - self.eye) @ self.world_from_camera).astype(
            np.float32
        )

    def project(self, points, size):
        """Image coordinates (N, 2) [pixels] and depths along the view axis (N,) [m]."""
        focal, cx, cy = self.intrinsics(size)
        x, y, z = ((np.asarray(points, np.float64) - self.eye) @ self.world_from_camera).T
        return np.stack([cx + focal * x / z, cy + focal * y / z], axis=1), z
