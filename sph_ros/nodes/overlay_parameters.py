# SPDX-License-Identifier: Apache-2.0
"""Parameters of the overlay: what it listens to, and how it draws."""

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException

from sph_ros.nodes.marker_parameters import IMAGE_KINDS

BOX_STYLES = ("wireframe", "shaded")

# name -> (default, lowest, highest, text)
_NUMBERS = {
    "liquid_delay": (0.05, 0.0, 1.0, "a picture shows the liquid of so much later [s]: it follows"
                     " the hand that late"),
    "desk_height": (0.0, -100.0, 100.0, "of the plane under everything, in the liquid's frame [m]"),
    "spacing": (0.0, 0.0, 1.0, "of the particles [m]; 0: measured"),
}  # fmt: skip


class OverlayParameterError(ValueError):
    """A parameter cannot be used; one line that says why."""


class OverlayParameters:
    """The parameters of an ar_overlay.

    Args:
        node: that gets them.

    Raises:
        OverlayParameterError: one of them is wrong.
    """

    def __init__(self, node):
        self._node = node
        fixed = self._declare_fixed
        fixed("fluid", "/fluid", "name of the fluid node, with its namespace")
        fixed("camera_pose", "/marker_tracker/camera_pose", "topic of the camera's poses")
        fixed("camera_info_url", "", "calibration (ROS or OpenCV YAML); empty: camera_info topic")
        fixed("image_kind", "auto", f"one of {', '.join(IMAGE_KINDS)}; auto: by the topic's name")
        self._declare("cards", [""], "solid:side of square cards [m] that hide the liquid")
        self._declare("boxes", "wireframe", f"how boxes are drawn: {' or '.join(BOX_STYLES)}")
        for name, (default, low, high, text) in _NUMBERS.items():
            limits = [FloatingPointRange(from_value=low, to_value=high)]
            self._declare(name, default, text, floating_point_range=limits)
        quality = [IntegerRange(from_value=1, to_value=100)]
        self._declare("jpeg_quality", 85, "of ~/image/compressed", integer_range=quality)
        problem = _problem({name: self[name] for name in ("cards", "boxes", "image_kind")})
        if problem:
            raise OverlayParameterError(problem)
        node.add_on_set_parameters_callback(_check)

    def __getitem__(self, name):
        """Present value of a parameter."""
        return self._node.get_parameter(name).value

    def cards(self):
        """Side [m] of the card on each solid by name."""
        return _cards(self["cards"])

    def _declare_fixed(self, name, default, text):
        self._declare(name, default, text, read_only=True)

    def _declare(self, name, default, text, **descriptor):
        descriptor = ParameterDescriptor(name=name, description=text, **descriptor)
        try:
            self._node.declare_parameter(name, default, descriptor)
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
            limits = "".join(f", expected {one.from_value:g} to {one.to_value:g}" for one in ranges)
            raise OverlayParameterError(f"parameter {name}: {error}{limits}") from error


def _cards(texts):
    """Name -> side [m]; ValueError for what cannot be read."""
    cards = {}
    for text in filter(str.strip, texts):
        name, _, side = text.partition(":")
        cards[name.strip()] = float(side)
        if not 0.0 < cards[name.strip()] < 100.0:
            raise ValueError(text)
    return cards


def _problem(values):
    """What is wrong with values of parameters by name, in words; None if nothing is."""
    for name, words in (("boxes", BOX_STYLES), ("image_kind", IMAGE_KINDS)):
        if name in values and values[name] not in words:
            expected = ", ".join(words)
            return f"parameter {name}: expected one of {expected}, got {values[name]!r}"
    try:
        _cards(values.get("cards", []))
    except ValueError:
        return f"parameter cards: expected solid:side in metres, got {values['cards']!r}"
    return None


def _check(parameters):
    """Refuse what cannot be drawn. Changes nothing."""
    problem = _problem({parameter.name: parameter.value for parameter in parameters})
    return SetParametersResult(successful=problem is None, reason=problem or "")
