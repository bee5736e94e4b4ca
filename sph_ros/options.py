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
