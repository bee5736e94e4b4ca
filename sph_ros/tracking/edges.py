# SPDX-License-Identifier: Apache-2.0
"""Corners of a marker from the lines through its four sides.

`cv2.cornerSubPix` finds where edges cross; at the lone corner of a black square it is drawn inside
by some tenths of a pixel, the more the stronger the blur. A line through the middle of the step
from black to white along a whole side has no such bias, and averages over many more pixels.
"""

import cv2
import numpy as np

#: Samples along each side, and the part of the side they cover: corners are rounded by blur.
SAMPLES = 24
COVERED = (0.1, 0.9)

#: Profiles reach so far to both sides of a side [modules], within the black border, and [pixels].
REACH_MODULES = 0.8
REACH = (1.5, 4.0)

_STEPS = 17  # samples along a profile
_WEAK = 0.25  # of a profile's steepest slope: less is noise
_LEAST_CONTRAST = 4.0  # [grey values per pixel]
_LEAST_SIDE = 8.0  # [pixels]
_CENTRED = 0.4  # [pixels]
_PASSES = 5  # OpenCV's corners of an oblique marker can be four pixels off

_NEXT, _BEFORE, _OPPOSITE = [1, 2, 3, 0], [3, 0, 1, 2], [2, 3, 0, 1]
_SHARES = np.linspace(*COVERED, SAMPLES)
_PROFILE = np.linspace(-1.0, 1.0, _STEPS)


def edge_corners(gray, corners, modules):
    """Refined corners (4, 2) [pixels]; None where the sides cannot be made out.

    Args:
        gray: (H, W) uint8.
        corners: (4, 2) good to a pixel or two, in OpenCV's order.
        modules: of the marker along a side, border included.
    """
    for _ in range(_PASSES):
        lines = _side_lines(gray, corners, modules)
        better = None if lines is None else _crossings(*lines)
        if better is None:
            return None
        shift = float(np.abs(better - corners).max())
        corners = better
        if shift < _CENTRED:  # else the profiles were not centred on the edge: once more
            return corners
    return None


def _side_lines(gray, corners, modules):
    """A point (4, 2) and a direction (4, 2) of the line through each side; None on failure."""
    along = corners[_NEXT] - corners
    lengths = np.sqrt(np.sum(along**2, axis=1))
    if lengths.min() < _LEAST_SIDE:
        return None
    directions = along / lengths[:, None]
    outwards = np.column_stack([directions[:, 1], -directions[:, 0]])
    # Height of the marker over each side: it may be seen nearly edge-on.
    opposite = corners[_OPPOSITE] - corners
    heights = -np.sum(opposite * outwards, axis=1)
    if heights.min() < modules:
        return None
    reach = np.clip(REACH_MODULES * heights / modules, *REACH)
    offsets = reach[:, None] * _PROFILE  # (4, K)
    feet = corners[:, None] + _SHARES[None, :, None] * along[:, None]  # (4, M, 2)
    places = feet[:, :, None] + offsets[:, None, :, None] * outwards[:, None, None]
    places = places.astype(np.float32).reshape(4 * SAMPLES, _STEPS, 2)
    profiles = cv2.remap(gray, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    found, good = _step_offsets(profiles.reshape(4, SAMPLES, _STEPS).astype(float), offsets)
    if good.sum(axis=1).min() < SAMPLES // 3:
        return None
    starts, slopes = _fit(_SHARES, found, good)
    points = corners + starts[:, None] * outwards
    return points, along + slopes[:, None] * outwards


def _step_offsets(profiles, offsets):
    """Where each profile goes from black to white (4, M) [pixels], and whether it does."""
    slopes = np.diff(profiles, axis=2)
    middles = 0.5 * (offsets[:, 1:] + offsets[:, :-1])
    steepest = slopes.max(axis=2)
    spacing = offsets[:, 1] - offsets[:, 0]
    weights = np.maximum(slopes - _WEAK * steepest[:, :, None], 0.0)
    sums = np.maximum(weights.sum(axis=2), 1e-9)
    found = np.einsum("smk,sk->sm", weights, middles) / sums
    return found, steepest > _LEAST_CONTRAST * spacing[:, None]


def _fit(shares, found, good):
    """Offset at share 0 (4,) and slope (4,) of lines through samples, outliers left out."""
    for _ in range(2):
        weights = good.astype(float)
        total = np.maximum(weights.sum(axis=1), 1.0)
        mean_share = weights @ shares / total
        mean_found = np.sum(weights * found, axis=1) / total
        centred = shares - mean_share[:, None]
        spread = np.maximum(np.sum(weights * centred**2, axis=1), 1e-9)
        slopes = np.sum(weights * centred * (found - mean_found[:, None]), axis=1) / spread
        starts = mean_found - slopes * mean_share
        errors = np.abs(found - starts[:, None] - slopes[:, None] * shares)
        median = np.partition(errors, SAMPLES // 2, axis=1)[:, SAMPLES // 2]
        limit = 2.5 * np.maximum(median, 0.05)
        good = good & (errors <= limit[:, None])
    return starts, slopes


def _crossings(points, directions):
    """Corners (4, 2) where each side's line meets the one before; None for parallel lines."""
    before, before_directions = points[_BEFORE], directions[_BEFORE]
    gap = points - before
    cross = _cross(before_directions, directions)
    if np.abs(cross).min() < 1e-3 * np.abs(directions).max() ** 2:
        return None
    return before + before_directions * (_cross(gap, directions) / cross)[:, None]


def _cross(a, b):
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
