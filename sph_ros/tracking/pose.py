# SPDX-License-Identifier: Apache-2.0
"""Where a target is in the camera's frame, from the corners of its markers.

A plane seen from afar has two poses that fit nearly as well, mirrored about the line of sight.
IPPE gives both (Collins & Bartoli 2014, Infinitesimal Plane-Based Pose Estimation); each is refined
to the least reprojection error (Levenberg-Marquardt), and none is dropped here.
"""

from typing import NamedTuple

import cv2
import numpy as np

from sph_ros.tracking.se3 import Pose, difference, exp, hat

#: Two solutions that differ less are one: [m] per metre of distance, and [rad].
SAME_POSITION, SAME_ANGLE = 1e-3, 2e-3

#: Relative thickness below which a set of points is a plane.
PLANAR = 1e-4


#: Least share of a well-known direction's information that any direction gets.
UNKNOWN = 1e-8


#: Steps of Gauss and Newton towards the most probable pose.
RELINEARIZATIONS = 2

#: More squared error over variance [-] than the best fit has, and the prediction is not believed.
MISFIT = 30.0


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


def estimate_poses(target, detections, camera, corner_noise):
    """All poses of a target that fit, best first; none when OpenCV finds none.

    Args:
        target: a Target.
        detections: of its markers, each id once.
        camera: a CameraModel.
        corner_noise: standard deviation of a corner along x and y [pixels].
    """
    points = np.ascontiguousarray(target.points([d.id for d in detections]))
    pixels = np.ascontiguousarray(np.concatenate([d.corners for d in detections]))
    starts = _starts(target, detections, camera, points, pixels)
    solutions = []
    for start in starts:
        pose = _refined(start, points, pixels, camera)
        if pose is None or any(_same(pose, other.pose) for other in solutions):
            continue
        solutions.append(_solution(pose, points, pixels, camera, corner_noise))
    return sorted(solutions, key=lambda solution: solution.chi_squared)[:2]


def _starts(target, detections, camera, points, pixels):
    """Poses to refine: both of IPPE for a plane, else those of the largest markers."""
    if len(detections) == 1:
        return _marker_starts(target, detections[0], camera)
    if _is_planar(points):
        return _ippe(points, pixels, camera, cv2.SOLVEPNP_IPPE)
    areas = [cv2.contourArea(d.corners.astype(np.float32)) for d in detections]
    largest = sorted(zip(areas, range(len(areas)), strict=True), reverse=True)[:2]
    starts = []
    for _, index in largest:
        starts += _marker_starts(target, detections[index], camera)
    errors = [np.sum((_project(s, points, camera)[0] - pixels) ** 2) for s in starts]
    return [starts[i] for i in np.argsort(errors)[:3]]


def _marker_starts(target, detection, camera):
    size = target.marker_size(detection.id)
    square = 0.5 * size * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], float)
    pixels = np.ascontiguousarray(detection.corners)
    marker_from_target = target.marker_pose(detection.id).inverse()
    poses = _ippe(square, pixels, camera, cv2.SOLVEPNP_IPPE_SQUARE)
    return [camera_from_marker @ marker_from_target for camera_from_marker in poses]


def _ippe(points, pixels, camera, method):
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            points, pixels, camera.matrix, camera.distortion, flags=method
        )
    except cv2.error:  # corners on a line
        return []
    poses = [
        Pose(cv2.Rodrigues(turn)[0], shift.ravel())
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    return [p for p in poses if np.isfinite(p.position).all() and np.isfinite(p.rotation).all()]


def _refined(pose, points, pixels, camera):
    """The pose of least reprojection error near `pose`; None where it is not before the camera."""
    turn = cv2.Rodrigues(pose.rotation)[0]
    shift = np.array(pose.position).reshape(3, 1)
    try:
        turn, shift = cv2.solvePnPRefineLM(
            points, pixels, camera.matrix, camera.distortion, turn, shift
        )
    except cv2.error:
        return None
    refined = Pose(cv2.Rodrigues(turn)[0], shift.ravel())
    depths = refined.apply(points)[:, 2]
    good = np.isfinite(refined.rotation).all() and np.isfinite(depths).all() and depths.min() > 0.0
    return refined if good else None


def _project(pose, points, camera):
    """Pixels (N, 2) and their derivatives (2 N, 6) by an error of the pose, see `se3`."""
    in_camera = np.ascontiguousarray(pose.apply(points))
    zero = np.zeros(3)
    pixels, jacobian = cv2.projectPoints(in_camera, zero, zero, camera.matrix, camera.distortion)
    by_shift = jacobian[:, 3:6]
    # exp(error) turns R X alone, so d(point)/d(turn) = -hat(R X); the chain goes through the point.
    turned = in_camera - pose.position
    by_turn = -np.einsum("nij,njk->nik", by_shift.reshape(-1, 2, 3), hat(turned)).reshape(-1, 3)
    return pixels[:, 0], np.hstack([by_shift, by_turn])


def _solution(pose, points, pixels, camera, corner_noise):
    projected, jacobian = _project(pose, points, camera)
    squares = float(np.sum((projected - pixels) ** 2))
    chi_squared = squares / corner_noise**2
    # Blur or a bad calibration show in the residual: then the corners are noisier than assumed.
    freedom = max(pixels.size - 6, 1)
    variance = corner_noise**2 * max(1.0, chi_squared / freedom / 4.0)
    # Columns scaled to length one, for pixels per metre and per radian differ by orders; a trace of
    # prior knowledge keeps the inverse finite where an edge-on marker leaves a direction unknown.
    scale = 1.0 / np.maximum(np.linalg.norm(jacobian, axis=0), 1e-6)
    scaled = jacobian * scale
    inverse = np.linalg.inv(scaled.T @ scaled + UNKNOWN * np.eye(6))
    covariance = variance * inverse * np.outer(scale, scale)
    return Solution(pose, chi_squared, covariance, float(np.sqrt(squares / len(pixels))))


def relinearized(solution, prior, target, detections, camera, corner_noise):
    """The same corners as a measurement linear about what they and the prediction amount to.

    Seen face on, a marker's picture changes with the square of its tilt: about its own solution the
    corners seem to know the tilt well, although noise alone made it. About the most probable pose
    they do not (iterated extended Kalman filter, Bell & Cathey 1993).

    Args:
        solution: a Solution that the corners alone gave.
        prior: predicted camera_from_target and its covariance (6, 6), as a pair.
        target, detections, camera, corner_noise: as in `estimate_poses`.

    Returns:
        (camera_from_target, covariance (6, 6)): those of `solution` where the prediction does not
        fit the corners.
    """
    points = np.ascontiguousarray(target.points([d.id for d in detections]))
    pixels = np.concatenate([d.corners for d in detections])
    variance = corner_noise**2 * max(1.0, solution.chi_squared / max(pixels.size - 6, 1) / 4.0)
    precision = np.linalg.inv(prior[1])
    pose = prior[0]
    for iteration in range(RELINEARIZATIONS + 1):
        projected, jacobian = _project(pose, points, camera)
        errors = (pixels - projected).ravel()
        information = jacobian.T @ jacobian / variance
        pull = jacobian.T @ errors / variance
        if iteration < RELINEARIZATIONS:
            back = difference(prior[0], pose)
            pose = perturbed(
                pose, np.linalg.solve(information + precision, pull + precision @ back)
            )
            if not pose.apply(points)[:, 2].min() > 0.0:
                return solution.pose, solution.covariance
    if float(errors @ errors) > variance * (
        solution.chi_squared * corner_noise**2 / variance + MISFIT
    ):
        return solution.pose, solution.covariance
    covariance = np.linalg.inv(information + UNKNOWN * np.diag(np.diag(information)))
    return perturbed(pose, covariance @ pull), covariance


def _is_planar(points):
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return extent[2] < PLANAR * extent[0]


def _same(a, b):
    if np.linalg.norm(a.position - b.position) > SAME_POSITION * np.linalg.norm(b.position):
        return False
    # trace = 1 + 2 cos(angle)
    return np.trace(a.rotation @ b.rotation.T) > 1.0 + 2.0 * np.cos(SAME_ANGLE)


def perturbed(pose, error):
    """The pose with an error (6,) added, see `se3`."""
    return Pose(exp(error[3:]) @ pose.rotation, pose.position + error[:3])
