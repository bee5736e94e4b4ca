# SPDX-License-Identifier: Apache-2.0
"""Values on command lines; what cannot be used is refused in words."""

import argparse
import math


def positive(text: str) -> float:
    """A number above 0."""
    return _number(text, "above 0", lambda value: value > 0.0)


def not_negative(text: str) -> float:
    """A number of at least 0."""
    return _number(text, "of at least 0", lambda value: value >= 0.0)


def remapping(text: str) -> tuple[str, str]:
    """The two names of `A:=B`."""
    old, sign, new = text.partition(":=")
    if not (old and sign and new):
        raise argparse.ArgumentTypeError(f"expected A:=B, got {text!r}")
    return old, new


def picture_size(text: str) -> tuple[int, int]:
    """Width and height of `960x720`; videos take even numbers only."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT such as 960x720, got {text!r}")
    size = int(width), int(height)
    if not all(16 <= side <= 8192 and side % 2 == 0 for side in size):
        raise argparse.ArgumentTypeError(f"expected even numbers from 16 to 8192, got {text!r}")
    return size


def _number(text, wanted, accepted):
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and accepted(value)):
        raise argparse.ArgumentTypeError(f"expected a number {wanted}, got {text!r}")
    return value


def count(text):
    """Argparse type: a whole number above 0."""
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, got {text!r}")
    return number


def numbers(text):
    """Argparse type: `1,1.5,2`, or `1:2:0.5` for the same, as a tuple of floats."""
    separator = ":" if ":" in text else ","
    try:
        values = [float(part) for part in text.split(separator)]
    except ValueError:
        values = []
    if not values or not all(math.isfinite(value) for value in values):
        raise argparse.ArgumentTypeError(
            f"expected numbers such as 1,1.5,2 or FIRST:LAST:STEP, got {text!r}"
        )
    if separator == ",":
        return tuple(dict.fromkeys(values))
    if len(values) != 3 or values[2] <= 0.0 or values[1] < values[0]:
        raise argparse.ArgumentTypeError(f"expected FIRST:LAST:STEP, got {text!r}")
    first, last, step = values
    steps = int((last - first) / step + 1e-6)
    if steps > 1000:
        raise argparse.ArgumentTypeError(f"expected at most 1000 numbers, got {text!r}")
    return tuple(round(first + index * step, 9) for index in range(steps + 1))
