# SPDX-License-Identifier: Apache-2.0
"""Where a target is in the camera's frame, from the corners of its markers.

A plane seen from afar has two poses that fit nearly as well, mirrored about the line of sight.
IPPE gives both (Collins & Bartoli 2014, Infinitesimal Plane-Based Pose Estimation); each is refined
to the least reprojection error (Levenberg-Marquardt), and none is dropped here.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np

from sph_ros.core.pinhole import best_pose, covariance_of, most_probable_pose
from sph_ros.tracking.se3 import Pose, exp

#: Two solutions that differ less are one: [m] per metre of distance, and [rad].
SAME_POSITION, SAME_ANGLE = 1e-3, 2e-3

#: Relative thickness below which a set of points is a plane.
PLANAR = 1e-4

#: Steps of Gauss and Newton towards the most probable pose.
RELINEARIZATIONS = 2

#: More squared error over variance [-] than the best fit has, and the prediction is not believed.
MISFIT = 30.0

#: Residuals so many times larger than the corner noise are taken for noisier corners.
TOLERATED = 2.0


class Solution(NamedTuple):
    """One pose that fits.

    Attributes:
        pose: camera_from_target.
        chi_squared: sum of squared corner errors over the corner noise squared [-].
        covariance: of the pose in the camera's frame, (6, 6), see `se3`.
        residual: root mean square error of a corner [pixels].
    """

    pose: Pose
    chi_squared: float
    covariance: np.ndarray
    residual: float


class Sighting(NamedTuple):
    """What one picture shows of a target.

    Attributes:
        points: corners in the target's frame, (N, 3) [m].
        pixels: the same in the picture, (N, 2).
        camera: CameraModel.
        corner_noise: standard deviation of a corner along x and y [pixels].
    """

    points: np.ndarray
    pixels: np.ndarray
    camera: object
    corner_noise: float

    def variance(self, chi_squared):
        """Of a corner: blur or a bad calibration show in the best fit, and make it larger."""
        freedom = max(self.pixels.size - 6, 1)
        return self.corner_noise**2 * max(1.0, chi_squared / freedom / TOLERATED**2)


def sighting_of(target, detections, camera, corner_noise):
    """The Sighting of a target; `detections` are of its markers, each id once."""
    pixels = np.concatenate([detection.corners for detection in detections])
    return Sighting(target.points([d.id for d in detections]), pixels, camera, corner_noise)


def estimate_poses(target, detections, camera, corner_noise):
    """All poses of a target that fit, best first; none when OpenCV finds none.

    Args:
        target: a Target.
        detections: of its markers, each id once.
        camera: a CameraModel.
        corner_noise: standard deviation of a corner along x and y [pixels].
    """
    sighting = sighting_of(target, detections, camera, corner_noise)
    solutions = []
    for start in _starts(target, detections, sighting):
        solution = _solution(start, sighting)
        if solution and not any(_same(solution.pose, other.pose) for other in solutions):
            solutions.append(solution)
    return sorted(solutions, key=lambda solution: solution.chi_squared)[:2]


def _starts(target, detections, sighting):
    """Poses to refine: both of IPPE for a plane, else those of the largest markers."""
    camera = sighting.camera
    if len(detections) == 1:
        return _marker_starts(target, detections[0], camera)
    if _is_planar(sighting.points):
        return _ippe(sighting.points, sighting.pixels, camera, cv2.SOLVEPNP_IPPE)
    areas = [cv2.contourArea(d.corners.astype(np.float32)) for d in detections]
    starts = []
    for index in np.argsort(areas)[:-3:-1]:
        starts += _marker_starts(target, detections[index], camera)
    errors = [np.sum((camera.project(s.apply(sighting.points)) - sighting.pixels) ** 2)
              for s in starts]  # fmt: skip
    return [starts[i] for i in np.argsort(errors)[:3]]


def _marker_starts(target, detection, camera):
    square = target.square(detection.id)
    poses = _ippe(square, detection.corners, camera, cv2.SOLVEPNP_IPPE_SQUARE)
    marker_from_target = target.marker_pose(detection.id).inverse()
    return [camera_from_marker @ marker_from_target for camera_from_marker in poses]


def _ippe(points, pixels, camera, method):
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            points, np.ascontiguousarray(pixels), camera.matrix, camera.distortion, flags=method
        )
    except cv2.error:  # corners on a line
        return []
    return [
        Pose(cv2.Rodrigues(turn)[0], shift.ravel())
        for turn, shift in zip(turns, shifts, strict=True)
    ]


def _solution(start, sighting):
    """The Solution near a pose; None where there is none before the camera."""
    rotation, position, squares, information = best_pose(
        start.rotation, start.position, sighting.points, sighting.pixels, *sighting.camera.lens
    )
    if not math.isfinite(squares):
        return None
    chi_squared = squares / sighting.corner_noise**2
    covariance = covariance_of(information, sighting.variance(chi_squared))
    residual = math.sqrt(squares / len(sighting.pixels))
    return Solution(Pose(rotation, position), chi_squared, covariance, residual)


def relinearized(solution, prior, sighting):
    """The same corners as a measurement linear about what they and the prediction amount to.

    Seen face on, a marker's picture changes with the square of its tilt: about its own solution the
    corners seem to know the tilt well, although noise alone made it. About the most probable pose
    they do not (iterated extended Kalman filter, Bell & Cathey 1993).

    Args:
        solution: a Solution that the corners alone gave.
        prior: predicted camera_from_target and its covariance (6, 6), as a pair.
        sighting: Sighting of the corners.

    Returns:
        (camera_from_target, covariance (6, 6)): those of `solution` where the prediction does not
        fit the corners.
    """
    pose, spread = prior
    variance = sighting.variance(solution.chi_squared)
    rotation, position, covariance, squares = most_probable_pose(
        np.ascontiguousarray(pose.rotation),
        np.ascontiguousarray(pose.position),
        np.ascontiguousarray(spread),
        sighting.points,
        sighting.pixels,
        variance,
        RELINEARIZATIONS,
        *sighting.camera.lens,
    )
    if not squares <= solution.chi_squared * sighting.corner_noise**2 + MISFIT * variance:
        return solution.pose, solution.covariance
    return Pose(rotation, position), covariance


def _is_planar(points):
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return extent[2] < PLANAR * extent[0]


def _same(a, b):
    if math.dist(a.position, b.position) > SAME_POSITION * math.hypot(*b.position):
        return False
    # The trace of A B^T, 1 + 2 cos(angle).
    return np.vdot(a.rotation, b.rotation) > 1.0 + 2.0 * math.cos(SAME_ANGLE)


def perturbed(pose, error):
    """The pose with an error (6,) added, see `se3`."""
    return Pose(exp(error[3:]) @ pose.rotation, pose.position + error[:3])
