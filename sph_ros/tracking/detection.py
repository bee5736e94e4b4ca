# SPDX-License-Identifier: Apache-2.0
"""Markers in a grey picture: one thin layer over the old and the new functions of cv2.aruco.

OpenCV 4.6 (Ubuntu 24.04's) has only functions, OpenCV 5 only `ArucoDetector`. Corners are refined
here and not by cv2.aruco, whose refinement differs between versions.
"""

from typing import NamedTuple

import cv2
import numpy as np

from sph_ros.tracking.edges import edge_corners

#: A sub-pixel window reaches so far [modules of the marker] to each side of a corner, so that it
#: sees the border's corner and nothing of the pattern inside.
REFINE_MODULES = 0.6
MAX_REFINE_WINDOW = 6  # [pixels]

#: A corner that refinement moves further [modules] has found something else.
MAX_REFINE_SHIFT, MAX_EDGE_SHIFT = 0.5, 0.7

#: A region of interest reaches further than the marker by this share of its size.
ROI_MARGIN = 0.6
MIN_ROI_MARGIN = 24  # [pixels]


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
        self._find = _finder(self._dictionary)

    def detect(self, gray, regions=None):
        """All accepted markers, an id perhaps more than once.

        Args:
            gray: (H, W) uint8.
            regions: where to look, [(left, top, right, bottom)] in pixels; None for everywhere.
        """
        if regions is None:
            return self._detect_in(gray, 0, 0, gray)
        found = []
        for left, top, right, bottom in regions:
            part = np.ascontiguousarray(gray[top:bottom, left:right])
            for detection in self._detect_in(part, left, top, gray):
                if not any(_same(detection, other) for other in found):
                    found.append(detection)
        return found

    def _detect_in(self, part, left, top, gray):
        if min(part.shape) < 8:
            return []
        all_corners, ids = self._find(part)
        found = []
        for marker_id, corners in zip(ids, all_corners, strict=True):
            if self._ids is None or marker_id in self._ids:
                corners = corners.reshape(4, 2) + (left, top)
                if self._refine:
                    corners = self._refined(gray, corners)
                found.append(Detection(int(marker_id), corners.astype(float)))
        return found

    def _refined(self, gray, corners):
        """Corners to a fraction of a pixel; where that fails they stay as they are."""
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        allowed = max(3.0, MAX_EDGE_SHIFT * float(sides.mean()) / self._modules)
        better = edge_corners(gray, corners, self._modules)
        if better is not None and float(np.abs(better - corners).max()) <= allowed:
            return better
        return _corner_sub_pixel(gray, corners, float(sides.min()) / self._modules)


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


def region_around(corners, shape, motion=0.0):
    """(left, top, right, bottom) [pixels] in which a marker must be, cut to the picture.

    Args:
        corners: (N, 2) expected pixels of its corners.
        shape: (height, width) of the picture.
        motion: how far it may have gone besides [pixels].
    """
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = max(MIN_ROI_MARGIN, ROI_MARGIN * float((high - low).max())) + motion
    left, top = np.maximum(np.floor(low - margin), 0).astype(int)
    right, bottom = np.minimum(np.ceil(high + margin) + 1, shape[::-1]).astype(int)
    return int(left), int(top), int(max(right, left)), int(max(bottom, top))


def merged_regions(regions):
    """Regions without overlap: those that overlap become the one around both."""
    regions = list(regions)
    merged = []
    while regions:
        one = regions.pop()
        hit = next((r for r in regions if _overlap(one, r)), None)
        if hit is None:
            merged.append(one)
            continue
        regions.remove(hit)
        low, high = np.minimum(one[:2], hit[:2]), np.maximum(one[2:], hit[2:])
        regions.append((*map(int, low), *map(int, high)))
    return merged


def _overlap(a, b):
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _same(a, b):
    """Whether two detections are one marker, seen in two regions."""
    return a.id == b.id and float(np.abs(a.corners - b.corners).max()) < 3.0


def _finder(dictionary):
    """A function from a picture to (list of corners, ids (N,)), for whichever OpenCV there is."""
    if hasattr(cv2.aruco, "ArucoDetector"):
        find = cv2.aruco.ArucoDetector(dictionary, cv2.aruco.DetectorParameters()).detectMarkers
    else:
        parameters = cv2.aruco.DetectorParameters_create()

        def find(picture):
            return cv2.aruco.detectMarkers(picture, dictionary, parameters=parameters)

    def find_markers(picture):
        corners, ids, _rejected = find(picture)
        return corners, [] if ids is None else np.ravel(ids).tolist()

    return find_markers
