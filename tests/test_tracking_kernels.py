# SPDX-License-Identifier: Apache-2.0
"""Compiled arithmetic of the tracker against OpenCV, against matrices, against differences."""

import cv2
import naive_motion as naive
import numpy as np
import pytest
from tracking_helpers import BALL, CAMERA, CAMERA_FROM_WORLD, WORLD, seen

import sph_ros.core.edge_lines
import sph_ros.core.motion_filter
import sph_ros.core.pinhole
from sph_ros.core.pinhole import best_pose, most_probable_pose
from sph_ros.tracking.camera import CameraModel
from sph_ros.tracking.filter import Measurement, MotionSettings, mean, predict, start, surprise
from sph_ros.tracking.filter import update as filter_update
from sph_ros.tracking.pose import perturbed
from sph_ros.tracking.preparation import prepare
from sph_ros.tracking.se3 import Pose, difference, exp, pose_from_quaternion
from sph_ros.tracking.tracker import Tracker, TrackerSettings

# OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y.
COEFFICIENTS = np.array(
    [0.2, -0.3, 0.002, -0.003, 0.1, 0.15, -0.1, 0.05, 0.004, -0.002, 0.003, 0.001, 0.03, -0.05]
)
MATRIX = [[500.0, 0.0, 321.0], [0.0, 510.0, 238.0], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize("count", [0, 4, 5, 8, 12, 14])
def test_projection_is_opencvs_for_all_its_models(count):
    rng = np.random.default_rng(count)
    points = np.column_stack([rng.uniform(-0.3, 0.3, (40, 2)), rng.uniform(0.5, 1.0, 40)])
    camera = CameraModel(640, 480, MATRIX, COEFFICIENTS[:count])
    zero = np.zeros(3)
    theirs = cv2.projectPoints(points, zero, zero, camera.matrix, COEFFICIENTS[:count])[0][:, 0]
    assert np.abs(camera.project(points) - theirs).max() < 1e-9


@pytest.mark.parametrize("count", [0, 14])
def test_best_pose_is_where_the_gradient_of_the_error_vanishes(count):
    """From a wrong start; and its information is that of differences of the projection."""
    rng = np.random.default_rng(0)
    camera = CameraModel(640, 480, MATRIX, COEFFICIENTS[:count])
    points = rng.uniform(-0.06, 0.06, (8, 3))
    true = Pose(exp(np.array([2.8, 0.3, -0.2])), np.array([0.03, -0.02, 0.5]))
    noisy = camera.project(true.apply(points)) + 0.5 * rng.standard_normal((8, 2))
    begin = perturbed(true, np.array([0.02, -0.01, 0.05, 0.2, -0.1, 0.15]))
    rotation, position, squares, information = best_pose(*begin, points, noisy, *camera.lens)
    found = Pose(rotation, position)
    columns = []
    for axis in np.eye(6) * 1e-6:
        ahead, behind = (
            camera.project(perturbed(found, sign * axis).apply(points)) for sign in (1.0, -1.0)
        )
        columns.append((ahead - behind).ravel() / 2e-6)
    jacobian = np.array(columns).T
    errors = (noisy - camera.project(found.apply(points))).ravel()
    assert squares == pytest.approx(float(errors @ errors))
    assert np.allclose(information, jacobian.T @ jacobian, rtol=1e-5, atol=1e-3)
    step = np.linalg.solve(information, jacobian.T @ errors)
    assert np.abs(step).max() < 1e-6
    # Nothing before the camera, nothing found.
    behind = Pose(true.rotation, -true.position)
    assert best_pose(*behind, points, noisy, *camera.lens)[2] == np.inf


def test_most_probable_pose_is_least_squares_with_the_prediction():
    rng = np.random.default_rng(1)
    points = BALL.points(BALL.ids)
    true = Pose(exp(np.array([3.0, 0.2, 0.1])), np.array([0.02, 0.01, 0.5]))
    prior = perturbed(true, 0.3 * rng.standard_normal(6) * 0.01)
    covariance = np.diag([1e-6, 1e-6, 1e-5, 1e-3, 1e-3, 1e-4])
    pixels = seen(BALL, true, rng)[0].corners
    rotation, position, alone, squares = most_probable_pose(
        *prior, covariance, points, pixels, 0.09, 4, *CAMERA.lens
    )
    # The measurement and the prediction combined, as the filter does it next.
    gap = difference(Pose(rotation, position), prior)
    gain = covariance @ np.linalg.inv(covariance + alone)
    joint = perturbed(prior, gain @ gap)

    def cost(pose):
        errors = (pixels - CAMERA.project(pose.apply(points))).ravel()
        off = difference(pose, prior)
        return errors @ errors / 0.09 + off @ np.linalg.solve(covariance, off)

    least = cost(joint)
    for axis in np.eye(6):
        for size in (1e-4, -1e-4):
            assert cost(perturbed(joint, size * axis)) > least - 1e-3
    assert squares < 9.0 and cost(prior) > least + 1.0


def test_filter_is_the_one_of_matrices():
    """Thirty measurements of a turning hand: means, covariances, weights, surprises."""
    rng = np.random.default_rng(2)
    settings = MotionSettings()
    covariance = np.diag([1e-6, 1e-6, 4e-6, 1e-4, 1e-4, 1e-5])
    state = kinds = None
    for k in range(30):
        turn = exp(np.array([0.02 * k, 0.1, 0.05 * k])) @ exp(0.01 * rng.standard_normal(3))
        place = np.array([0.01 * k, 0.002 * k * k, 0.1]) + 1e-3 * rng.standard_normal(3)
        measurement = Measurement(Pose(turn, place), covariance)
        if state is None:
            state = start(measurement, settings)
            kinds = [naive.Kind(place, turn, np.zeros(6), state.covariances[m]) for m in range(3)]
            weights = np.full(3, 1.0 / 3.0)
            continue
        elapsed, glide = (0.033, None) if k % 7 else (0.25, (0.17, 0.4))
        state = predict(state, elapsed, settings, glide)
        travel, left = glide or (elapsed, 1.0)
        kinds, weights = naive.predicted(kinds, weights, settings, elapsed, travel, left)
        kinds_after, weights_after, distances = naive.updated(kinds, weights, *measurement)
        expected = np.min(distances - 2.0 * np.log(weights))
        assert surprise(state, measurement) == pytest.approx(expected, rel=1e-6)
        state, kinds, weights = filter_update(state, measurement), kinds_after, weights_after
    assert np.allclose(state.weights, weights, rtol=1e-6)
    for m, kind in enumerate(kinds):
        assert np.allclose(state.positions[m], kind.position, atol=1e-10)
        assert np.allclose(state.rotations[m], kind.rotation, atol=1e-9)
        assert np.allclose(state.covariances[m], kind.covariance, rtol=1e-6, atol=1e-12)
    one = naive.merged(kinds, weights, naive.likeliest(kinds, weights))
    estimate = mean(state)
    assert np.allclose(estimate.pose.position, one.position, atol=1e-10)
    assert np.allclose(estimate.pose.rotation, one.rotation, atol=1e-9)
    assert np.allclose(np.r_[estimate.velocity, estimate.spin], one.rates, atol=1e-8)
    assert np.allclose(estimate.covariance, one.covariance, rtol=1e-6, atol=1e-12)


def test_quaternions_and_matrices_of_all_turns():
    rng = np.random.default_rng(3)
    turns = [*rng.standard_normal((200, 4)), *np.eye(4), *-np.eye(4), (1, 1, 0, 1e-9)]
    for quat in turns:
        unit = np.array(quat) / np.linalg.norm(quat)
        pose = pose_from_quaternion((1, 2, 3), 3.0 * unit)
        vector, angle = unit[:3], 2.0 * np.arccos(np.clip(abs(unit[3]), 0, 1))
        if angle > 1e-6:
            axis = np.sign(unit[3] or 1.0) * vector / np.linalg.norm(vector)
            assert np.allclose(pose.rotation, cv2.Rodrigues(axis * angle)[0], atol=1e-7)
        again = pose.quat_xyzw
        assert min(np.abs(again - unit).max(), np.abs(again + unit).max()) < 1e-9
        assert again[3] >= 0.0


def compiled():
    """Kernel -> number of signatures, of all kernels that the tracker may call."""
    modules = (sph_ros.core.edge_lines, sph_ros.core.motion_filter, sph_ros.core.pinhole)
    return {
        name: len(thing.signatures)
        for module in modules for name, thing in vars(module).items()
        if hasattr(thing, "signatures")
    }  # fmt: skip


@pytest.mark.parametrize("filter", ["kalman", "one_euro", "none"])
def test_nothing_is_compiled_after_the_preparation(filter):
    """A kernel compiled for another layout of arrays would stop the tracker for seconds."""
    assert prepare().solids["solid"].status == "tracking"
    before = compiled()
    if not any(before.values()):
        pytest.skip("nothing is compiled here: NUMBA_DISABLE_JIT")
    rng = np.random.default_rng(0)
    tracker = Tracker(TrackerSettings(solids=(BALL,), world=WORLD, filter=filter))
    for k in range(60):
        found = seen(WORLD, CAMERA_FROM_WORLD, rng) if k % 5 else []
        if k % 7 and not 30 < k < 50:
            place = Pose(exp(rng.normal(0, 0.05, 3)), np.array([0.1, 0.002 * k, 0.05]))
            found += seen(BALL, CAMERA_FROM_WORLD @ place, rng)
        tracking = tracker.track(found, CAMERA, k / 30.0, lookahead=0.05)
        for tracked in (tracking.world, *tracking.solids.values()):
            _ = tracked.pose and tracked.pose.quat_xyzw
    assert compiled() == before
