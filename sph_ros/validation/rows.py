# SPDX-License-Identifier: Apache-2.0
"""What a check finds: rows of the table and curves of its plot."""

import math
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Curve:
    """A curve of a plot.

    Attributes:
        label: for the legend.
        x, y: (n,).
        truth: drawn as a line beside what was measured.
    """

    label: str
    x: np.ndarray
    y: np.ndarray
    truth: bool = False


@dataclass(frozen=True)
class Plot:
    """Curves over common axes; labels carry the units."""

    x_label: str
    y_label: str
    curves: tuple[Curve, ...]


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        name: of the quantity; the same for every solver.
        truth, measured: in `unit`.
        unit: "" if there is none.
        error: how far the measurement is off, as a share of what `within` is a share of [-].
        within: largest error that passes [-].
        remark: more, for people.
        plot: what stands behind it, or None.
    """

    name: str
    truth: float
    measured: float
    unit: str
    error: float
    within: float
    remark: str = ""
    plot: Plot | None = field(default=None, compare=False)

    @property
    def passed(self):
        """Whether the error is within the tolerance; what is no number is not."""
        return math.isfinite(self.error) and self.error <= self.within


def relative_row(name, truth, measured, unit, within, **more):
    """A row whose error is that of the number itself, relative to the truth."""
    return Row(name, truth, measured, unit, abs(measured - truth) / abs(truth), within, **more)
