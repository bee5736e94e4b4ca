# SPDX-License-Identifier: Apache-2.0
"""Fields of frozen dataclasses that hold numbers: unit and limits are declared where the field is.

    radius: float = quantity("m", above=0.0)

and `check_quantities(self)` in `__post_init__` turns all of them into floats or tuples of floats,
or raises ValueError("field: what was expected [unit], what was given").
"""

import dataclasses
import math

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

# What the numbers of a vector are, by the field's type.
_VECTORS = {
    Vector: "3 numbers (x, y, z)",
    Vector | None: "3 numbers (x, y, z)",
    Quaternion: "4 numbers (x, y, z, w)",
}


def quantity(unit, default=dataclasses.MISSING, *, low=-math.inf, high=math.inf, above=None):
    """A field that holds a number, or as many as its type says.

    Args:
        unit: of the number, for messages; "1" if it has none.
        default: None makes the field optional.
        low: lowest accepted value.
        high: highest accepted value; infinity is accepted only where it is the default.
        above: lower bound that is not itself accepted.
    """
    limits = {"unit": unit, "low": low, "high": high, "above": above}
    limits["endless"] = default == math.inf
    return dataclasses.field(default=default, metadata=limits)


def limits_of(cls):
    """(low, high) of every quantity of a dataclass, by field."""
    return {
        item.name: (item.metadata["low"], item.metadata["high"])
        for item in dataclasses.fields(cls)
        if "unit" in item.metadata
    }


def check_quantities(instance):
    """Turn every quantity into float or a tuple of floats.

    Raises:
        ValueError: a value is no finite number or outside its limits; names the field.
    """
    for item in dataclasses.fields(instance):
        value = getattr(instance, item.name)
        if "unit" not in item.metadata or (value is None and item.default is None):
            continue
        if item.type in _VECTORS:
            value = _vector(item, value)
        else:
            value = _number(item.name, value, item.metadata)
        replace_fields(instance, **{item.name: value})


def replace_fields(instance, **fields):
    """Store normalised values; frozen dataclasses allow it only this way, while they are made."""
    for name, value in fields.items():
        object.__setattr__(instance, name, value)


def unit_vector(name, value):
    """Numbers divided by their length.

    Raises:
        ValueError: the length is zero; names the field.
    """
    length = math.sqrt(math.fsum(item * item for item in value))
    if length < 1e-9:
        raise ValueError(f"{name}: expected a length greater than 0, got {list(value)}")
    return tuple(item / length for item in value)


def _vector(item, value):
    wanted = _VECTORS[item.type]
    length = int(wanted[0])
    if isinstance(value, (str, dict)) or not hasattr(value, "__len__") or len(value) != length:
        raise ValueError(f"{item.name}: expected {wanted}, got {value!r}")
    return tuple(_number(f"{item.name}[{i}]", v, item.metadata) for i, v in enumerate(value))


def _number(name, value, limits):
    unit = "" if limits["unit"] == "1" else f" [{limits['unit']}]"
    if isinstance(value, (bool, str)) or not hasattr(value, "__float__"):
        raise ValueError(f"{name}: expected a number{unit}, got {value!r}")
    try:
        number = float(value)
    except OverflowError:
        raise ValueError(f"{name}: expected a finite number{unit}, got a larger one") from None
    if not math.isfinite(number) and not (limits["endless"] and number == math.inf):
        raise ValueError(f"{name}: expected a finite number{unit}, got {value!r}")
    low, high, above = limits["low"], limits["high"], limits["above"]
    if above is not None and not number > above:
        raise ValueError(f"{name}: expected a number greater than {above:g}{unit}, got {number:g}")
    if not low <= number <= high:
        wanted = f"{low:g} to {high:g}" if math.isfinite(high) else f"at least {low:g}"
        if not math.isfinite(low):
            wanted = f"at most {high:g}" if above is None else f"above {above:g} to {high:g}"
        raise ValueError(f"{name}: expected {wanted}{unit}, got {number:g}")
    return number
