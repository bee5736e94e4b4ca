# SPDX-License-Identifier: Apache-2.0
"""Markers in a grey picture: one thin layer over the old and the new functions of cv2.aruco.

OpenCV 4.6 (Ubuntu 24.04's) has only functions, OpenCV 5 only `ArucoDetector`. Corners are refined
here and not by cv2.aruco, whose refinement differs between versions.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np

from sph_ros.core.edge_lines import edge_corners

#: A sub-pixel window reaches so far [modules of the marker] to each side of a corner, so that it
#: sees the border's corner and nothing of the pattern inside.
REFINE_MODULES = 0.6
MAX_REFINE_WINDOW = 6  # [pixels]

#: A corner that refinement moves further [modules] has found something else.
MAX_REFINE_SHIFT, MAX_EDGE_SHIFT = 0.5, 0.7

#: Window of the one threshold of a quick search [pixels], and in half the resolution: those that
#: miss least of sharp and blurred, bright and dim, small and large markers.
QUICK_WINDOW, QUICK_WINDOW_HALVED = 13, 9

#: Nothing is found in a smaller region [pixels].
LEAST_REGION = 8


class DictionaryError(ValueError):
    """There is no such marker dictionary."""


class Detection(NamedTuple):
    """A marker in a picture: its id, and its corners (4, 2) [pixels] from top left, clockwise."""

    id: int
    corners: np.ndarray


def dictionary_names():
    """Names such as DICT_4X4_50, as OpenCV spells them."""
    return sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))


def get_dictionary(name):
    """cv2's dictionary of a name; DictionaryError when there is none."""
    if name not in dictionary_names():
        raise DictionaryError(
            f"dictionary is {name!r}, expected one of {', '.join(dictionary_names())}"
        )
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def marker_picture(dictionary, marker_id, pixels):
    """The marker with its black border, (pixels, pixels) uint8."""
    draw = getattr(cv2.aruco, "generateImageMarker", None) or cv2.aruco.drawMarker
    return draw(dictionary, marker_id, pixels)


class Detector:
    """Finds the markers of one dictionary.

    Args:
        dictionary: name such as DICT_4X4_50.
        ids: those that are accepted; None for all. Small dictionaries find false ones in clutter.
        refine: whether corners are refined to a fraction of a pixel.

    Raises:
        DictionaryError: no such dictionary, or an id that is not in it.
    """

    def __init__(self, dictionary, ids=None, refine=True):
        self._dictionary = get_dictionary(dictionary)
        self._ids = None if ids is None else frozenset(ids)
        self._refine = refine
        self._modules = self._dictionary.markerSize + 2  # the border has one on each side
        count = len(self._dictionary.bytesList)
        wrong = sorted(i for i in self._ids or () if not 0 <= i < count)
        if wrong:
            raise DictionaryError(
                f"marker id {wrong[0]}: {dictionary} has the ids 0 to {count - 1}"
            )
        self._thorough = _finder(self._dictionary, None)
        self._quick = _finder(self._dictionary, QUICK_WINDOW)
        self._quick_halved = _finder(self._dictionary, QUICK_WINDOW_HALVED)

    def detect(self, gray):
        """All accepted markers of a picture (H, W) uint8, an id perhaps more than once."""
        gray = _read_only(gray)
        ids, all_corners = self._thorough(gray)
        return self._accepted(gray, ids, [corners.reshape(4, 2) for corners in all_corners])

    def detect_in(self, gray, region, least_perimeter=0.0, quick=True, halved=False):
        """The same in a part of a picture.

        Args:
            gray: (H, W) uint8.
            region: (left, top, right, bottom) [pixels].
            least_perimeter: of a marker [pixels]. In a small picture OpenCV takes every speck for a
                candidate otherwise, which takes ten times as long.
            quick: with one threshold only, a third of the work; misses some in bad light.
            halved: in half the resolution, a quarter of the work; for large markers.
        """
        gray = _read_only(gray)
        left, top, right, bottom = region
        width, height = right - left, bottom - top
        if min(width, height) < LEAST_REGION:
            return []
        part = np.ascontiguousarray(gray[top:bottom, left:right])
        if halved:  # without the last of an odd number of pixels; cv2.resize is slow with it
            size = (width // 2, height // 2)
            even = part[: 2 * size[1], : 2 * size[0]]
            part = cv2.resize(even, size, interpolation=cv2.INTER_AREA)
            least_perimeter /= 2.0
        find = (self._quick_halved if halved else self._quick) if quick else self._thorough
        ids, all_corners = find(part, least_perimeter)
        # The centre of a pixel is at a whole number.
        scale, offset = (2.0, 0.5) if halved else (1.0, 0.0)
        places = [scale * c.reshape(4, 2) + (left + offset, top + offset) for c in all_corners]
        return self._accepted(gray, ids, places)

    def _accepted(self, gray, ids, places):
        """Detections of the ids that are wanted, refined."""
        return [
            Detection(marker_id, self._refined(gray, corners.astype(float)))
            for marker_id, corners in zip(ids, places, strict=True)
            if self._ids is None or marker_id in self._ids
        ]

    def _refined(self, gray, corners):
        """Corners to a fraction of a pixel; where that fails they stay as they are."""
        if not self._refine:
            return corners
        sides = [math.dist(corners[i - 1], corners[i]) for i in range(4)]
        allowed = max(3.0, MAX_EDGE_SHIFT * 0.25 * sum(sides) / self._modules)
        better, good = edge_corners(gray, corners, self._modules)
        if good and float(np.abs(better - corners).max()) <= allowed:
            return better
        return _corner_sub_pixel(gray, corners, min(sides) / self._modules)


def _read_only(gray):
    """The same pixels as what comes in messages: kernels are compiled for read-only arrays only."""
    gray = np.ascontiguousarray(gray).view()
    gray.flags.writeable = False
    return gray


def _corner_sub_pixel(gray, corners, module):
    """OpenCV's refinement, for markers too small for lines through their sides."""
    window = int(min(MAX_REFINE_WINDOW, REFINE_MODULES * module))
    if window < 1:
        return corners
    start = np.ascontiguousarray(corners, np.float32).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
    better = cv2.cornerSubPix(gray, start.copy(), (window, window), (-1, -1), criteria)[:, 0]
    shift = np.linalg.norm(better - corners, axis=1)
    good = shift <= max(1.5, MAX_REFINE_SHIFT * module)
    return np.where(good[:, None], better, corners)


def _finder(dictionary, window):
    """A function from a picture and a least perimeter [pixels] to (ids, list of corners).

    Args:
        dictionary: of cv2.
        window: of the one adaptive threshold [pixels]; None for the three that OpenCV takes.
    """
    modern = hasattr(cv2.aruco, "ArucoDetector")
    parameters = (cv2.aruco.DetectorParameters if modern else cv2.aruco.DetectorParameters_create)()
    if window is not None:
        parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = window
    detector = cv2.aruco.ArucoDetector(dictionary, parameters) if modern else None
    least_rate = parameters.minMarkerPerimeterRate

    def find(picture, least_perimeter=0.0):
        parameters.minMarkerPerimeterRate = max(least_rate, least_perimeter / max(picture.shape))
        if modern:
            detector.setDetectorParameters(parameters)
            corners, ids, _rejected = detector.detectMarkers(picture)
        else:
            corners, ids, _rejected = cv2.aruco.detectMarkers(
                picture, dictionary, parameters=parameters
            )
        return ([] if ids is None else np.ravel(ids).tolist()), corners

    return find
