# SPDX-License-Identifier: Apache-2.0
"""Where to look for markers in the next picture, as cheaply as will do.

Searching a whole picture with all of OpenCV's thresholds takes ten times as long as everything
after it. A marker that is followed is looked for where it should be, first quickly, then
thoroughly; the whole picture is searched coarsely for those that are missing, and thoroughly every
now and then.
"""

import math
from typing import NamedTuple

import numpy as np

#: A region reaches further than the marker by this share of its size, and by so many pixels: first,
#: and once more where it was not found.
MARGINS = ((0.6, 24.0), (1.0, 40.0))

#: Share of the expected perimeter that a marker has at least.
SHRUNK = 0.5

#: Markers whose sides are longer [pixels] are found as well in half the resolution.
LARGE = 50.0

#: A target that was lost so recently [s] has a place where it should be, and is looked for in every
#: picture.
RECENTLY = 0.5

#: Whole pictures are searched thoroughly so often [s] while something is missing: small markers and
#: bad light escape a coarse search.
MISSING_INTERVAL = 0.3

#: Two detections are one marker when no corner is further apart [pixels].
SAME = 3.0


class Expected(NamedTuple):
    """What is known about a target before a picture is searched.

    Attributes:
        ids: of its markers.
        pixels: where its corners should be, (N, 2), four for each marker; None when not known.
        age: since it was last seen [s].
    """

    ids: tuple
    pixels: np.ndarray | None
    age: float


class Found(NamedTuple):
    """Detections, and the regions that were searched; None for the whole picture."""

    detections: list
    regions: list | None


class Search:
    """Looks for targets, picture after picture.

    Args:
        detector: a Detector.
        search_interval: whole pictures are searched for missing targets so often [s].
        full_interval: whole pictures are searched thoroughly so often [s]; 0 for all.
    """

    def __init__(self, detector, search_interval, full_interval):
        self._detector = detector
        self._search_interval = search_interval
        self._full_interval = full_interval
        self.reset()

    def reset(self):
        """Begin with the whole picture."""
        self._last_coarse = self._last_full = -math.inf

    def find(self, gray, expected, time, interval):
        """The markers of a picture.

        Args:
            gray: (H, W) uint8.
            expected: an Expected of each target.
            time: of the picture [s].
            interval: between pictures [s].
        """
        # Half an interval early: stamps are never exact.
        if time - self._last_full >= self._full_interval - 0.5 * interval:
            return self._everywhere(gray, time)
        regions, detections = self._near(gray, expected)
        missing = _missing(expected, detections)
        if not missing:
            return Found(detections, regions)
        recently = any(target.age < RECENTLY for target in missing)
        if not recently and time - self._last_coarse < self._search_interval - 0.5 * interval:
            return Found(detections, regions)
        self._last_coarse = time
        _add(detections, self._detector.detect_in(gray, _whole(gray), halved=True))
        patience = self._search_interval if recently else MISSING_INTERVAL
        if _missing(expected, detections) and time - self._last_full >= patience - 0.5 * interval:
            return self._everywhere(gray, time)
        return Found(detections, None)

    def _everywhere(self, gray, time):
        self._last_full = self._last_coarse = time
        return Found(self._detector.detect(gray), None)

    def _near(self, gray, expected):
        """(regions, detections) where targets should be."""
        wanted, regions, detections = expected, [], []
        for (share, least), quick in zip(MARGINS, (True, False), strict=True):
            near = [target for target in wanted if target.pixels is not None]
            places = [region_around(target.pixels, gray.shape, share, least) for target in near]
            sides = [_shortest_side(target.pixels) for target in near]
            for region in merged_regions(places):
                side = min(s for s, p in zip(sides, places, strict=True) if _within(p, region))
                halved, perimeter = quick and side > LARGE, SHRUNK * 4.0 * side
                found = self._detector.detect_in(gray, region, perimeter, quick, halved)
                _add(detections, found)
                regions.append(region)
            wanted = _missing(near, detections)
            if not wanted:
                break
        return regions, detections


def _missing(expected, detections):
    """Those of which no marker was found."""
    seen = {detection.id for detection in detections}
    return [target for target in expected if seen.isdisjoint(target.ids)]


def _add(detections, more):
    """Append those that are not there yet: regions overlap."""
    for new in more:
        if not any(
            new.id == old.id and float(np.abs(new.corners - old.corners).max()) < SAME
            for old in detections
        ):
            detections.append(new)


def _shortest_side(pixels):
    """Of all markers with these corners, (N, 2) [pixels]."""
    quads = pixels.reshape(-1, 4, 2)
    sides = quads - quads[:, [1, 2, 3, 0]]
    return math.sqrt(np.einsum("msx,msx->ms", sides, sides).min())


def _whole(gray):
    return (0, 0, gray.shape[1], gray.shape[0])


def region_around(pixels, shape, share, least):
    """(left, top, right, bottom) [pixels] in which a target must be, cut to the picture.

    Args:
        pixels: (N, 2) where its corners should be.
        shape: (height, width) of the picture.
        share: of its size by which it may be elsewhere [-].
        least: it may be so far elsewhere in any case [pixels].
    """
    (low_x, low_y), (high_x, high_y) = pixels.min(axis=0).tolist(), pixels.max(axis=0).tolist()
    margin = max(least, share * max(high_x - low_x, high_y - low_y))
    left, top = max(math.floor(low_x - margin), 0), max(math.floor(low_y - margin), 0)
    right = min(math.ceil(high_x + margin) + 1, shape[1])
    bottom = min(math.ceil(high_y + margin) + 1, shape[0])
    return left, top, max(right, left), max(bottom, top)


def merged_regions(regions):
    """Regions that overlap much become the one around them: what is searched twice costs twice."""
    merged = []
    for region in regions:
        partner = _partner(region, merged)
        while partner is not None:  # what has grown may have another one
            merged.remove(partner)
            region = _around(region, partner)
            partner = _partner(region, merged)
        merged.append(region)
    return merged


def _partner(region, others):
    """One of several with which a region is smaller together than apart; None without one."""
    for other in others:
        if _area(_around(region, other)) <= _area(region) + _area(other):
            return other
    return None


def _around(a, b):
    return min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])


def _area(region):
    return (region[2] - region[0]) * (region[3] - region[1])


def _within(region, other):
    return _around(region, other) == other
