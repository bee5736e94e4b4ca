# SPDX-License-Identifier: Apache-2.0
"""Checks of what callers hand in; an error names the input, what it was, what was expected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def rows(values: np.ndarray, name: str, columns: int, *dtypes: type) -> np.ndarray:
    """``values`` as it is, if it is a (N, columns) array of one of ``dtypes``; else ValueError."""
    expected = f"expected (N, {columns}) of {' or '.join(np.dtype(d).name for d in dtypes)}"
    if not isinstance(values, np.ndarray):
        raise ValueError(f"{name} is {type(values).__name__}, {expected}")
    if values.ndim != 2 or values.shape[1] != columns or values.dtype not in dtypes:
        raise ValueError(f"{name} has shape {values.shape} of {values.dtype}, {expected}")
    return values


def column(values: np.ndarray, name: str, length: int, dtype: type) -> np.ndarray:
    """``values`` as it is, if it is a (length,) array of ``dtype``; else ValueError."""
    expected = f"expected ({length},) of {np.dtype(dtype).name}"
    if not isinstance(values, np.ndarray):
        raise ValueError(f"{name} is {type(values).__name__}, {expected}")
    if values.shape != (length,) or values.dtype != dtype:
        raise ValueError(f"{name} has shape {values.shape} of {values.dtype}, {expected}")
    return values


def numbers(values: Sequence[float] | np.ndarray, name: str, length: int) -> tuple[float, ...]:
    """``length`` floats from any sequence; ValueError otherwise. NaN and infinity may pass."""
    try:
        result = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is {values!r}, expected {length} numbers") from None
    if len(result) != length:
        raise ValueError(f"{name} has {len(result)} numbers, expected {length}")
    return result
