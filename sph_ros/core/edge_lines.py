# SPDX-License-Identifier: Apache-2.0
"""Corners of a marker from the lines through its four sides.

`cv2.cornerSubPix` finds where edges cross; at the lone corner of a black square it is drawn inside
by some tenths of a pixel, the more the stronger the blur. A line through the middle of the step
from black to white along a whole side has no such bias, and averages over many more pixels.
"""

import math

import numpy as np

from sph_ros.core.jit import device, kernel

#: Samples along each side, and the part of the side they cover: corners are rounded by blur.
SAMPLES = 24
COVERED = (0.1, 0.9)

#: Profiles reach so far to both sides of a side [modules], within the black border, and [pixels].
REACH_MODULES = 0.8
REACH = (1.5, 4.0)

_POINTS = 17  # samples along a profile
_WEAK = 0.25  # of a profile's steepest slope: less is noise
_LEAST_CONTRAST = 4.0  # [grey values per pixel]
_LEAST_SIDE = 8.0  # [pixels]
_CENTRED = 0.4  # [pixels]
_PASSES = 5  # OpenCV's corners of an oblique marker can be four pixels off
_OUTLYING = 2.5  # medians
_LEAST_MEDIAN = 0.05  # [pixels]


@kernel
def edge_corners(gray, corners, modules):
    """Refined corners (4, 2) [pixels], and whether the sides could be made out.

    Args:
        gray: (H, W) uint8.
        corners: (4, 2) good to a pixel or two, in OpenCV's order.
        modules: of the marker along a side, border included.
    """
    corners = corners.copy()
    points, directions = np.empty((4, 2)), np.empty((4, 2))
    for _ in range(_PASSES):
        for side in range(4):
            if not _side_line(gray, corners, side, modules, points, directions):
                return corners, False
        shift = 0.0
        for i in range(4):
            x, y, good = _crossing(points, directions, (i + 3) % 4, i)
            if not good:
                return corners, False
            shift = max(shift, abs(x - corners[i, 0]), abs(y - corners[i, 1]))
            corners[i, 0], corners[i, 1] = x, y
        if shift < _CENTRED:  # else the profiles were not centred on the edge: once more
            return corners, True
    return corners, False


@device
def _side_line(gray, corners, side, modules, points, directions):
    """Set point and direction, (4, 2) each, of the line through a side; whether there is one."""
    after, opposite = (side + 1) % 4, (side + 2) % 4
    left, top = corners[side, 0], corners[side, 1]
    along_x, along_y = corners[after, 0] - left, corners[after, 1] - top
    length = math.sqrt(along_x * along_x + along_y * along_y)
    if not length >= _LEAST_SIDE:
        return False
    out_x, out_y = along_y / length, -along_x / length
    # Height of the marker over the side: it may be seen nearly edge-on.
    height = (left - corners[opposite, 0]) * out_x + (top - corners[opposite, 1]) * out_y
    if not height >= modules:
        return False
    reach = min(max(REACH_MODULES * height / modules, REACH[0]), REACH[1])
    shares, found = np.empty(SAMPLES), np.empty(SAMPLES)
    good = np.empty(SAMPLES, np.bool_)
    count = 0
    for i in range(SAMPLES):
        shares[i] = COVERED[0] + (COVERED[1] - COVERED[0]) * i / (SAMPLES - 1)
        x, y = left + shares[i] * along_x, top + shares[i] * along_y
        found[i], good[i] = _step_offset(gray, x, y, out_x, out_y, reach)
        count += good[i]
    if count < SAMPLES // 3:
        return False
    start, slope = _fitted(shares, found, good)
    points[side, 0], points[side, 1] = left + start * out_x, top + start * out_y
    directions[side, 0], directions[side, 1] = along_x + slope * out_x, along_y + slope * out_y
    return True


@device
def _step_offset(gray, x, y, out_x, out_y, reach):
    """Where a profile through (x, y) goes from black to white [pixels], and whether it does."""
    spacing = 2.0 * reach / (_POINTS - 1)
    slopes = np.empty(_POINTS - 1)
    steepest = -np.inf
    before = _sample(gray, x - reach * out_x, y - reach * out_y)
    for k in range(1, _POINTS):
        offset = -reach + k * spacing
        value = _sample(gray, x + offset * out_x, y + offset * out_y)
        slopes[k - 1] = value - before
        steepest = max(steepest, slopes[k - 1])
        before = value
    total, moment = 0.0, 0.0
    for k in range(_POINTS - 1):
        weight = max(slopes[k] - _WEAK * steepest, 0.0)
        total += weight
        moment += weight * (-reach + (k + 0.5) * spacing)
    good = steepest > _LEAST_CONTRAST * spacing
    return (moment / total if good else 0.0), good


@device
def _sample(gray, x, y):
    """Grey value between pixels; those of the rim go on beyond it."""
    x = min(max(x, 0.0), gray.shape[1] - 1.0)
    y = min(max(y, 0.0), gray.shape[0] - 1.0)
    i, j = int(y), int(x)
    low, right = min(i + 1, gray.shape[0] - 1), min(j + 1, gray.shape[1] - 1)
    s, t = x - j, y - i
    above = (1.0 - s) * gray[i, j] + s * gray[i, right]
    below = (1.0 - s) * gray[low, j] + s * gray[low, right]
    return (1.0 - t) * above + t * below


@device
def _fitted(shares, found, good):
    """Offset at share 0 and slope of a line through samples, outliers left out."""
    start, slope = 0.0, 0.0
    errors = np.empty(SAMPLES)
    for _ in range(2):
        count, mean_share, mean_found = 0, 0.0, 0.0
        for i in range(SAMPLES):
            if good[i]:
                count += 1
                mean_share += shares[i]
                mean_found += found[i]
        mean_share, mean_found = mean_share / max(count, 1), mean_found / max(count, 1)
        spread, joint = 1e-9, 0.0
        for i in range(SAMPLES):
            if good[i]:
                spread += (shares[i] - mean_share) ** 2
                joint += (shares[i] - mean_share) * (found[i] - mean_found)
        slope = joint / spread
        start = mean_found - slope * mean_share
        for i in range(SAMPLES):
            errors[i] = abs(found[i] - start - slope * shares[i])
        limit = _OUTLYING * max(_median(errors), _LEAST_MEDIAN)
        for i in range(SAMPLES):
            good[i] = good[i] and errors[i] <= limit
    return start, slope


@device
def _median(values):
    """The value that at most half of all are below, and at most half above; by counting."""
    for i in range(len(values)):
        below, above = 0, 0
        for k in range(len(values)):
            below += values[k] < values[i]
            above += values[k] > values[i]
        if 2 * below <= len(values) and 2 * above <= len(values):
            return values[i]
    return values[0]


@device
def _crossing(points, directions, i, j):
    """Where line j meets line i (x, y), and whether they are not parallel."""
    gap_x, gap_y = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
    cross = directions[i, 0] * directions[j, 1] - directions[i, 1] * directions[j, 0]
    size = max(abs(directions[i, 0]), abs(directions[i, 1]))
    size *= max(abs(directions[j, 0]), abs(directions[j, 1]))
    if abs(cross) < 1e-3 * size:
        return 0.0, 0.0, False
    share = (gap_x * directions[j, 1] - gap_y * directions[j, 0]) / cross
    return points[i, 0] + share * directions[i, 0], points[i, 1] + share * directions[i, 1], True
