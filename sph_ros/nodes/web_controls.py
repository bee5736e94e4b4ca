# SPDX-License-Identifier: Apache-2.0
"""A number in the panel: a field for exact values over a slider for the hand. No rclpy."""

import math
import re
import time
from typing import NamedTuple

#: The slider's positions.
SLIDER_END, SLIDER_STEP = 100.0, 0.5

#: A range is spread by its logarithm where its ends differ by more than this factor; where it
#: begins at zero and ends above WIDE_END, from ZERO_FLOOR on.
WIDE_RATIO, WIDE_END, ZERO_FLOOR = 100.0, 5.0, 1.0e-4

#: What is typed is used when nothing more was typed for so long [s].
TYPING_PAUSE = 0.7

#: A control that somebody just used is not moved under their hand for so long [s].
HANDS_OFF = 1.5


class NumberInfo(NamedTuple):
    """A parameter that is a number.

    Attributes:
        value: present value.
        low, high: range.
        text: what it is.
    """

    value: float
    low: float
    high: float
    text: str

    @property
    def unit(self):
        """What stands in the last brackets of the text, or nothing."""
        found = re.findall(r"\[([^\]]+)\]", self.text)
        return found[-1] if found and found[-1] != "-" else ""


def share_of(value, low, high):
    """Position 0 to 1 on the slider of a value in a range."""
    floor = _floor(low, high)
    value = min(max(value, low), high)
    if floor is None:
        return (value - low) / (high - low)
    if value <= floor:
        return 0.0
    return math.log(value / floor) / math.log(high / floor)


def value_at(share, low, high):
    """Value in a range at a position 0 to 1 on the slider, to three digits."""
    floor = _floor(low, high)
    if share <= 0.0 or share >= 1.0:
        return high if share >= 1.0 else low
    value = low + share * (high - low) if floor is None else floor * (high / floor) ** share
    return min(max(float(f"{value:.3g}"), low), high)


def _floor(low, high):
    """Where the logarithmic part of a range begins; None for a linear range."""
    if low > 0.0 and high / low > WIDE_RATIO:
        return low
    return ZERO_FLOOR if low == 0.0 and high > WIDE_END else None


class NumberControl:
    """A field and a slider for one parameter.

    Args:
        gui: viser's; both go into its present container.
        label: in front of the field.
        info: NumberInfo.
    """

    def __init__(self, gui, label, info):
        self.label, self._info = label, info
        hint = f"{info.text[:1].upper()}{info.text[1:]}, {info.low:g} to {info.high:g}"
        self._field = gui.add_text(label.replace("_", " "), number_text(info.value), hint=hint)
        self._slider = gui.add_multi_slider(
            info.unit or " ", 0.0, SLIDER_END, SLIDER_STEP, (self._position(info.value),), marks=()
        )
        self._edit = self._used = None
        self._field.on_update(self._typed)
        self._slider.on_update(self._slid)

    def remove(self):
        """Take it away."""
        self._field.remove()
        self._slider.remove()

    def show(self, info):
        """The parameter is this now, whoever set it."""
        self._info = info
        if self._used is None or time.monotonic() - self._used > HANDS_OFF:
            self.restore()

    def restore(self):
        """Show the parameter's value, whatever was typed."""
        self._edit = None
        if parse_number(self._field.value) != self._info.value:
            self._field.value = number_text(self._info.value)
        position = (self._position(self._info.value),)
        if abs(self._slider.value[0] - position[0]) > 1e-9:
            self._slider.value = position

    def take(self):
        """The value that somebody wants, once; None where there is none.

        Raises:
            ValueError: what was typed is no number of the range; the text says so.
        """
        edit = self._edit
        if edit is None:
            return None
        value, moment = edit
        if isinstance(value, str) and time.monotonic() - moment < TYPING_PAUSE:
            return None
        if self._edit is edit:
            self._edit = None
        if not isinstance(value, str):
            return value
        number, low, high = parse_number(value), self._info.low, self._info.high
        unit = f" {self._info.unit}" if self._info.unit else ""
        if number is None:
            raise ValueError(f"{self.label}: expected a number, got {value.strip()!r}")
        if not low <= number <= high:
            raise ValueError(
                f"{self.label}: expected {low:g} to {high:g}{unit}, got {value.strip()}"
            )
        return number

    def _position(self, value):
        share = share_of(value, self._info.low, self._info.high)
        return round(share * SLIDER_END / SLIDER_STEP) * SLIDER_STEP

    # Coroutines run in the server's event loop, in the order of the events. Events without `client`
    # are the program's own writing.

    async def _typed(self, event):
        if event.client is not None:
            self._used = time.monotonic()
            self._edit = (self._field.value, self._used)

    async def _slid(self, event):
        if event.client is not None:
            self._used = time.monotonic()
            value = value_at(self._slider.value[0] / SLIDER_END, self._info.low, self._info.high)
            self._edit = (value, self._used)
            self._field.value = number_text(value)


def number_text(value):
    """A number as people write it."""
    return f"{value:.6g}"


def parse_number(text):
    """The number that a text is; None if it is none."""
    try:
        number = float(text.strip().replace(",", "."))
    except ValueError:
        return None
    return number if math.isfinite(number) else None
