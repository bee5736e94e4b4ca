# SPDX-License-Identifier: Apache-2.0
"""From a grey picture to the poses of the camera and of the solids, picture after picture."""

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from sph_ros.tracking.ambiguity import ChoiceSettings, PoseChooser, Prediction
from sph_ros.tracking.detection import Detector
from sph_ros.tracking.filter import Measurement
from sph_ros.tracking.limits import Limiter, Limits
from sph_ros.tracking.pose import estimate_poses, relinearized, sighting_of
from sph_ros.tracking.se3 import IDENTITY, Pose, composed_covariance, inverse_covariance
from sph_ros.tracking.search import RECENTLY, Expected, Search
from sph_ros.tracking.targets import Target, check_targets
from sph_ros.tracking.tracks import TrackSettings, make_track

#: Stamps that jump back further [s] begin another recording; smaller ones are stragglers.
RESTART_JUMP = 0.5

#: So many pictures one after another that are not newer begin another recording, too.
RESTART_COUNT = 3

#: Pauses between pictures longer than this [s] say nothing about their rate.
LONGEST_INTERVAL = 0.2

#: Markers nearer than this to the camera's plane [m] have no place in the picture.
NEAR = 0.01


@dataclass(frozen=True, eq=False)
class TrackerSettings:
    """What to look for, and how to follow it.

    Attributes:
        solids: Targets that drive solids.
        world: Target that defines the world's frame; None: the camera's own frame.
        dictionary: of the markers.
        filter: one of `tracks.FILTERS`.
        track: TrackSettings.
        choice: ChoiceSettings.
        limits: Limits of what comes out of the Kalman filter; None for no bounds.
        corner_noise: standard deviation of a corner along x and y [pixels].
        world_hold: so long after the world marker was last seen the camera is taken as still [s].
        search_interval: the whole picture is searched for missing targets so often [s].
        full_interval: it is searched thoroughly so often [s]; 0 for every picture.
    """

    solids: tuple = ()
    world: Target | None = None
    dictionary: str = "DICT_4X4_50"
    filter: str = "kalman"
    track: TrackSettings = field(default_factory=TrackSettings)
    choice: ChoiceSettings = field(default_factory=ChoiceSettings)
    limits: Limits | None = field(default_factory=Limits)
    corner_noise: float = 0.3
    world_hold: float = 3.0
    search_interval: float = 0.1
    full_interval: float = 1.0


class Tracked(NamedTuple):
    """A target in one picture.

    Attributes:
        name: of the target.
        status: tracking, coasting, lost, never seen, or no world.
        pose: in the world's frame, of a solid; world_from_camera for the world's target. None when
            it is not known or too old.
        covariance: of the pose, (6, 6), see `se3`.
        in_camera: camera_from_target, filtered; None when not known.
        residual: root mean square corner error in this picture [pixels]; NaN when not seen.
        rejected: measurements refused so far.
        age: since it was last seen [s].
        motion: weights of the filter's kinds of motion.
    """

    name: str
    status: str
    pose: Pose | None
    covariance: np.ndarray | None
    in_camera: Pose | None
    residual: float
    rejected: int
    age: float
    motion: np.ndarray


class Problem(NamedTuple):
    """Something is wrong with what is seen: `world` or `marker twice`, and a text for people."""

    kind: str
    text: str


class Tracking(NamedTuple):
    """All about one picture.

    Attributes:
        world: Tracked of the world's target; None without one.
        solids: name -> Tracked.
        detections: what was found.
        regions: where; None for the whole picture.
        problems: Problems.
    """

    world: Tracked | None
    solids: dict
    detections: list
    regions: list | None
    problems: list


class Tracker:
    """Follows targets through pictures of one camera.

    Args:
        settings: TrackerSettings.

    Raises:
        TargetError, DictionaryError: the settings contradict themselves.
    """

    def __init__(self, settings):
        self.settings = settings
        self._targets = (*settings.solids, *((settings.world,) if settings.world else ()))
        check_targets(self._targets)
        ids = [i for target in self._targets for i in target.ids]
        detector = Detector(settings.dictionary, ids)
        self._search = Search(detector, settings.search_interval, settings.full_interval)
        self.reset()

    def reset(self):
        """Forget everything seen."""
        self._time = self._first_stamp = None
        self._stragglers = 0
        self._interval = 1.0 / 30.0  # between pictures [s]
        self._search.reset()
        self._followed = {
            t.name: _Followed(t, self.settings, bounded=t is not self.settings.world)
            for t in self._targets
        }

    def process(self, gray, stamp_ns, camera, lookahead=0.0):
        """Where everything is.

        Args:
            gray: picture (H, W) uint8.
            stamp_ns: when it was taken [ns].
            camera: CameraModel of this picture.
            lookahead: poses are predicted so far beyond the stamp [s].

        Returns:
            Tracking; None for a picture that is not newer than the last one.

        Raises:
            CameraError: the calibration is for another size.
        """
        camera.check_size(gray.shape[1], gray.shape[0])
        if not self._advance(stamp_ns):
            return None
        found = self._search.find(gray, self._expected(camera), self._time, self._interval)
        tracking = self.track(found.detections, camera, self._time, lookahead)
        return tracking._replace(regions=found.regions)

    def track(self, detections, camera, time, lookahead=0.0):
        """The same from detections; times [s] must increase."""
        self._time = time
        detections, problems = self._unique(detections, camera, time)
        by_id = {detection.id: detection for detection in detections}
        world = self._observe_world(by_id, camera, time, lookahead)
        base = self._camera_from_world(time)
        solids = {}
        for target in self.settings.solids:
            followed = self._followed[target.name]
            followed.observe_in(base, by_id, camera, time)
            solids[target.name] = followed.tracked(base, time, lookahead)
        if world is not None and base is None:
            problems.append(Problem("world", self._world_text(world)))
        return Tracking(world, solids, detections, None, problems)

    def _advance(self, stamp_ns):
        """Set the time of a picture; whether it is newer than the last one."""
        if self._first_stamp is None:
            self._first_stamp = stamp_ns
        time = (stamp_ns - self._first_stamp) * 1e-9
        if self._time is not None and time <= self._time:
            self._stragglers += 1
            if self._time - time < RESTART_JUMP and self._stragglers < RESTART_COUNT:
                return False
            self.reset()
            self._first_stamp, time = stamp_ns, 0.0
        elif self._time is not None and time - self._time < LONGEST_INTERVAL:
            self._interval = time - self._time
        self._time, self._stragglers = time, 0
        return True

    def _expected(self, camera):
        """Where the corners of each target should be in this picture."""
        base = self._camera_from_world(self._time)
        expected = []
        for followed in self._followed.values():
            target, pixels = followed.target, None
            pose, age = followed.expected(base, self._time)
            if pose is not None:
                points = pose.apply(target.points(target.ids))
                pixels = camera.project(points) if points[:, 2].min() > NEAR else None
            expected.append(Expected(target.ids, pixels, age))
        return expected

    # ---------------------------------------------------------------- what was found

    def _unique(self, detections, camera, time):
        """Each id once: of several the one where the target should be, else none."""
        counts = Counter(detection.id for detection in detections)
        problems = []
        for marker_id in [i for i, count in counts.items() if count > 1]:
            same = [d for d in detections if d.id == marker_id]
            kept = self._nearest(marker_id, same, camera, time)
            detections = [d for d in detections if d.id != marker_id or d is kept]
            what = "none is used" if kept is None else "the nearest to where it was is used"
            text = f"marker {marker_id} was seen {len(same)} times: {what}"
            problems.append(Problem("marker twice", text))
        return detections, problems

    def _nearest(self, marker_id, detections, camera, time):
        followed = next(f for f in self._followed.values() if marker_id in f.target.corners)
        prediction = followed.prediction(self._camera_from_world(time), time)
        if prediction is None or followed.track.age(time) > self.settings.track.lost_time:
            return None
        points = prediction.pose.apply(followed.target.corners[marker_id])
        if points[:, 2].min() <= NEAR:
            return None
        pixels = camera.project(points)
        return min(detections, key=lambda d: float(np.abs(d.corners - pixels).max()))

    # ---------------------------------------------------------------- world

    def _observe_world(self, by_id, camera, time, lookahead):
        world = self.settings.world
        if world is None:
            return None
        followed = self._followed[world.name]
        followed.observe_in((IDENTITY, np.zeros((6, 6))), by_id, camera, time)
        return followed.as_world(time, self.settings.world_hold)

    def _camera_from_world(self, time):
        """(Pose, covariance) of the world in the camera's frame; None when not known."""
        if self.settings.world is None:
            return IDENTITY, np.zeros((6, 6))
        track = self._followed[self.settings.world.name].track
        if track.age(time) > self.settings.world_hold:
            return None
        return track.at(time).pose, held_covariance(track, time)

    def _world_text(self, world):
        ids = ", ".join(map(str, self.settings.world.ids[:5]))
        if world.age == math.inf:
            return f"the world marker (id {ids}) was never seen, so no pose can be given"
        return f"the world marker (id {ids}) was not seen for {world.age:.1f} s"


class _Followed:
    """One target: its chooser, its track, its limiter."""

    def __init__(self, target, settings, bounded):
        self.target = target
        self.track = make_track(settings.filter, settings.track)
        self._settings = settings
        self._chooser = PoseChooser(settings.choice)
        limited = bounded and settings.filter == "kalman" and settings.limits is not None
        self._limiter = Limiter(settings.limits) if limited else None
        self._residual = math.nan
        self._relinearize = settings.filter == "kalman"  # others take a measurement as a pose

    def prediction(self, base, time):
        """Prediction in the camera's frame; None when nothing is known.

        Args:
            base: (camera_from_reference, covariance) of the frame in which the track runs.
            time: [s].
        """
        estimate = self.track.at(time)
        if base is None or estimate is None:
            return None
        if self.target is self._settings.world:
            return Prediction(estimate.pose, estimate.covariance[:6, :6])
        covariance = composed_covariance(*base, estimate.pose, estimate.covariance[:6, :6])
        return Prediction(base[0] @ estimate.pose, covariance)

    def expected(self, base, time):
        """(pose, age): where to look for it in the camera's frame, and since when it is known [s].

        What was just found again counts as well before it is believed: else a target that was lost
        would be looked for everywhere once more. The pose is None when nothing new is known.
        """
        age = self.track.age(time)
        if age < RECENTLY:
            prediction = self.prediction(base, time)
            return prediction and prediction.pose, age
        if self.target is self._settings.world:
            base = IDENTITY, None
        found = self.track.candidate
        if base is None or found is None or time - found[0] >= RECENTLY:
            return None, age
        return base[0] @ found[1], time - found[0]

    def observe_in(self, base, by_id, camera, time):
        """Measure in the camera's frame, filter in the reference frame."""
        self._residual = math.nan
        detections = [by_id[i] for i in self.target.ids if i in by_id]
        if not detections:
            return
        solutions = estimate_poses(self.target, detections, camera, self._settings.corner_noise)
        if not solutions:
            return
        self._residual = solutions[0].residual
        if base is None:
            return
        lost = self.track.age(time) > self._settings.track.lost_time
        prediction = None if lost else self.prediction(base, time)
        choice = self._chooser.choose(solutions, prediction)
        measured = choice.solution.pose, choice.solution.covariance
        if self._relinearize and prediction is not None and not choice.flipped:
            sighting = sighting_of(self.target, detections, camera, self._settings.corner_noise)
            measured = relinearized(choice.solution, prediction, sighting)
        measurement = _in_reference(base, *measured)
        (self.track.restart if choice.flipped else self.track.observe)(time, measurement)

    def tracked(self, base, time, lookahead):
        """Tracked of a solid."""
        status = self.track.status(time)
        estimate = self.track.at(time + lookahead)
        pose = covariance = in_camera = None
        if estimate is not None:
            if status != "lost":
                pose, covariance = self._bounded(estimate, time), estimate.covariance[:6, :6]
            if base is not None:
                in_camera = base[0] @ self.track.at(time).pose
        if base is None:
            status = "no world"
        return self._make(status, pose, covariance, in_camera, time, estimate)

    def as_world(self, time, hold):
        """Tracked of the world's target: its pose is the camera's in the world."""
        estimate = self.track.at(time)
        pose = covariance = in_camera = None
        if estimate is not None and self.track.age(time) <= hold:
            in_camera = estimate.pose
            pose = in_camera.inverse()
            covariance = inverse_covariance(in_camera, held_covariance(self.track, time))
        return self._make(self.track.status(time), pose, covariance, in_camera, time, estimate)

    def _bounded(self, estimate, time):
        if self._limiter is None:
            return estimate.pose
        return self._limiter.follow(time, estimate.pose, estimate.velocity, estimate.spin)

    def _make(self, status, pose, covariance, in_camera, time, estimate):
        weights = np.ones(1) if estimate is None else estimate.weights
        return Tracked(
            self.target.name,
            status,
            pose,
            covariance,
            in_camera,
            self._residual,
            self.track.rejected,
            self.track.age(time),
            weights,
        )


def held_covariance(track, time):
    """Covariance (6, 6) of a target that nobody may have moved since it was last seen.

    While a hand hides the world marker, a camera that rested is taken to rest on; without this the
    doubt about the world would grow until no measurement of a solid counted any more.
    """
    seen = track.at(track.seen)
    if len(seen.weights) == 1:  # not a Kalman filter's
        return seen.covariance[:6, :6]
    kinds = track.settings.motion.kinds
    resting = seen.weights[[kind.acceleration is None for kind in kinds]].sum()
    return (seen if resting > 0.5 else track.at(time)).covariance[:6, :6]


def _in_reference(base, camera_from_target, covariance):
    """The Measurement in the frame of which (camera_from_reference, covariance) is given."""
    camera_from_reference, base_covariance = base
    reference_from_camera = camera_from_reference.inverse()
    back = inverse_covariance(camera_from_reference, base_covariance)
    return Measurement(
        reference_from_camera @ camera_from_target,
        composed_covariance(reference_from_camera, back, camera_from_target, covariance),
    )
