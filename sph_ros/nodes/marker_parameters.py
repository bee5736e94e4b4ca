# SPDX-License-Identifier: Apache-2.0
"""Parameters of the marker tracker: what to look for, where pictures come from, how to filter."""

from dataclasses import replace

from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException

from sph_ros.tracking.limits import Limits
from sph_ros.tracking.targets import (
    TargetError,
    check_targets,
    load_boards,
    parse_solid,
    single_marker,
)
from sph_ros.tracking.tracker import TrackerSettings
from sph_ros.tracking.tracks import FILTERS, TrackSettings

#: A board of this name defines the world instead of a marker.
WORLD = "world"

IMAGE_KINDS = ("auto", "raw", "rectified")

#: Value of the parameter `prediction` that stands for the measured age of a picture.
MEASURED = -1.0

_TRACK = TrackSettings()
_LIMITS = Limits()

# name -> (default, lowest, highest, text). Those of TrackSettings and Limits bear their names.
_TRACK_NUMBERS = {
    "gate": (_TRACK.gate, 1.0, 1e6, "squared Mahalanobis distance of an outlier [-]"),
    "coast_time": (_TRACK.coast_time, 0.0, 5.0, "an unseen marker goes on moving for so long [s]"),
    "stop_time": (_TRACK.stop_time, 0.001, 5.0, "then it stops with this time constant [s]"),
    "lost_time": (_TRACK.lost_time, 0.01, 60.0, "unseen for so long it sends no more poses [s]"),
    "min_cutoff": (_TRACK.min_cutoff, 0.001, 1000.0, "one_euro: cut-off at rest [Hz]"),
    "speed_coefficient": (_TRACK.speed_coefficient, 0.0, 1e5, "one_euro: beta [1/m]"),
    "angular_coefficient": (_TRACK.angular_coefficient, 0.0, 1e5, "one_euro: beta [1/rad]"),
}
_LIMIT_NUMBERS = {
    "max_speed": ("speed", 0.01, 100.0, "kalman: poses never move faster [m/s]"),
    "max_acceleration": ("acceleration", 0.1, 1e5, "kalman: nor accelerate more [m/s^2]"),
    "max_spin": ("spin", 0.01, 1000.0, "kalman: nor turn faster [rad/s]"),
    "max_angular_acceleration": ("angular_acceleration", 0.1, 1e6, "kalman: [rad/s^2]"),
}
_OTHER_NUMBERS = {
    "marker_size": (0.08, 0.0, 10.0, "side of the black square of a marker [m]"),
    "corner_noise": (0.3, 0.01, 20.0, "standard deviation of a marker's corner [pixels]"),
    "world_hold": (3.0, 0.0, 3600.0, "the camera is taken as still for so long without world [s]"),
    "full_interval": (1.0, 0.0, 60.0, "whole pictures are searched so often; 0: every one [s]"),
    "prediction": (0.0, MEASURED, 1.0, "poses are predicted so far beyond their stamp [s]; "
                   "-1: by the measured age of the picture"),
    "debug_rate": (10.0, 0.1, 1000.0, "debug pictures per second, at most [Hz]"),
}  # fmt: skip


# Parameters that change while the tracker runs, and need another one.
_OF_TRACKER = {
    *("filter", "marker_size", "corner_noise", "world_hold", "full_interval"),
    *_TRACK_NUMBERS,
    *_LIMIT_NUMBERS,
}


class TrackerParameterError(ValueError):
    """A parameter cannot be used; one line that says why."""


class MarkerParameters:
    """The parameters of a marker tracker.

    Args:
        node: that gets them.
    """

    def __init__(self, node):
        self._node = node
        fixed = self._declare_fixed
        fixed("source", "", "camera number, video file, folder or bag; empty: image topics", True)
        fixed("source_topic", "", "of a bag's pictures; empty: the only one")
        fixed("source_rate", 0.0, "pictures per second of a video or folder; 0: its own [Hz]")
        fixed("loop", False, "start the source over at its end")
        fixed("camera_info_url", "", "calibration (ROS or OpenCV YAML); empty: camera_info topic")
        fixed("image_kind", "auto", f"one of {', '.join(IMAGE_KINDS)}; auto: by the topic's name")
        fixed("dictionary", "DICT_4X4_50", "of the markers")
        fixed("world_marker", 0, "id of the marker that defines the world; -1: the camera")
        fixed("solid_markers", ["ball:1"], "name:id or name:id:size, size in metres")
        fixed("boards", "", f"YAML file of rigid sets of markers; one named {WORLD} is the world")
        fixed("world_frame", "world", "name of the world marker's frame")
        fixed("lazy", True, "do nothing while nobody listens to any pose or picture")
        fixed("publish_tf", True, "send poses to /tf as well, where tf2_ros is installed")
        self._declare("filter", "kalman", f"one of {', '.join(FILTERS)}")
        limits = {
            name: (getattr(_LIMITS, field), low, high, text)
            for name, (field, low, high, text) in _LIMIT_NUMBERS.items()
        }
        for name, numbers in {**_OTHER_NUMBERS, **_TRACK_NUMBERS, **limits}.items():
            self._declare_number(name, *numbers)
        self._check_words({"filter": self["filter"], "image_kind": self["image_kind"]})

    def __getitem__(self, name):
        """Present value of a parameter."""
        return self._node.get_parameter(name).value

    @property
    def source(self):
        """The source as text; a camera's number may have been given as a number."""
        return str(self["source"])

    def follow(self, apply):
        """From now on check every change, and call `apply()` after those that `settings` has."""

        def changed(parameters):
            if any(parameter.name in _OF_TRACKER for parameter in parameters):
                apply()

        self._node.add_on_set_parameters_callback(self._check)
        self._node.add_post_set_parameters_callback(changed)

    def solid_names(self):
        """Names of the solids, whose topics exist whatever the marker size is."""
        return [target.name for target in self._targets(self["marker_size"] or 1.0)[0]]

    def settings(self):
        """TrackerSettings.

        Raises:
            TargetError, DictionaryError: what is to be tracked cannot be.
        """
        size = self["marker_size"]
        if size <= 0.0:
            raise TargetError(f"marker_size is {size:g} m, expected above 0: set it to the printed")
        solids, world = self._targets(size)
        track = {name: self[name] for name in _TRACK_NUMBERS}
        limits = {field: self[name] for name, (field, *_) in _LIMIT_NUMBERS.items()}
        return TrackerSettings(
            solids=solids,
            world=world,
            dictionary=self["dictionary"],
            filter=self["filter"],
            track=replace(_TRACK, **track),
            limits=Limits(**limits),
            corner_noise=self["corner_noise"],
            world_hold=self["world_hold"],
            full_interval=self["full_interval"],
        )

    def _targets(self, size):
        """(solids, world or None)."""
        boards = load_boards(self["boards"]) if self["boards"] else {}
        world = boards.pop(WORLD, None)
        if world is None and self["world_marker"] >= 0:
            world = single_marker(WORLD, self["world_marker"], size)
        texts = [text for text in self["solid_markers"] if text.strip()]
        solids = (*(parse_solid(text, size) for text in texts), *boards.values())
        check_targets((*solids, *((world,) if world else ())))
        return solids, world

    # ---------------------------------------------------------------- declaring, checking

    def _declare_fixed(self, name, default, text, dynamic=False):
        self._declare(name, default, text, read_only=True, dynamic_typing=dynamic)

    def _declare_number(self, name, default, low, high, text):
        limits = [FloatingPointRange(from_value=float(low), to_value=float(high))]
        self._declare(name, float(default), text, floating_point_range=limits)

    def _declare(self, name, default, text, **descriptor):
        descriptor = ParameterDescriptor(name=name, description=text, **descriptor)
        try:
            self._node.declare_parameter(name, default, descriptor)
        except InvalidParameterTypeException as error:
            raise TrackerParameterError(f"parameter {name}: {text}: {error}") from error
        except InvalidParameterValueException as error:
            limits = "".join(
                f", expected {limit.from_value:g} to {limit.to_value:g}"
                for limit in descriptor.floating_point_range
            )
            raise TrackerParameterError(f"parameter {name}: {error}{limits}") from error

    def _check_words(self, values):
        for name, words in (("filter", FILTERS), ("image_kind", IMAGE_KINDS)):
            if name in values and values[name] not in words:
                raise TrackerParameterError(
                    f"parameter {name}: expected one of {', '.join(words)}, got {values[name]!r}"
                )

    def _check(self, parameters):
        """Refuse what no tracker can use. Changes nothing."""
        values = {parameter.name: parameter.value for parameter in parameters}
        try:
            self._check_words(values)
        except TrackerParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if values.get("marker_size", 1.0) <= 0.0:
            return SetParametersResult(successful=False, reason="marker_size: expected above 0")
        return SetParametersResult(successful=True)
