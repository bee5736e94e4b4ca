# SPDX-License-Identifier: Apache-2.0
"""What solids are made of: frozen shapes, each in a frame of its own, lengths in metres.

Every shape checks itself on construction and raises ValueError naming the field, the value and what
was expected, so that code further in need not ask again.
"""

import math
from dataclasses import dataclass

Vector = tuple[float, float, float]


def _number(name: str, value) -> float:
    if isinstance(value, (bool, str)):
        raise ValueError(f"{name}: expected a number, got {value!r}")
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: expected a number, got {value!r}") from None
    if not math.isfinite(number):
        raise ValueError(f"{name}: expected a finite number, got {value!r}")
    return number


def _positive(name: str, value) -> float:
    number = _number(name, value)
    if number <= 0.0:
        raise ValueError(f"{name}: expected a number greater than 0, got {value!r}")
    return number


def _not_negative(name: str, value) -> float:
    number = _number(name, value)
    if number < 0.0:
        raise ValueError(f"{name}: expected a number of at least 0, got {value!r}")
    return number


def _vector(name: str, value, length: int = 3) -> tuple[float, ...]:
    try:
        items = None if isinstance(value, str) else tuple(value)
    except TypeError:
        items = None
    if items is None or len(items) != length:
        raise ValueError(f"{name}: expected {length} numbers, got {value!r}")
    return tuple(_number(f"{name}[{index}]", item) for index, item in enumerate(items))


def _unit(name: str, value: tuple[float, ...]) -> tuple[float, ...]:
    norm = math.sqrt(math.fsum(item * item for item in value))
    if norm < 1e-9:
        raise ValueError(f"{name}: expected a length greater than 0, got {value!r}")
    return tuple(item / norm for item in value)


def _set(instance, **fields) -> None:
    """Store normalised values; frozen dataclasses allow it only this way, and only here."""
    for name, value in fields.items():
        object.__setattr__(instance, name, value)


@dataclass(frozen=True)
class Pose:
    """Where a frame sits in its parent: parent_point = rotate(quat_xyzw, point) + position.

    Attributes:
        position: origin of the frame [m].
        quat_xyzw: orientation, normalised on construction; a zero quaternion is refused.
    """

    position: Vector = (0.0, 0.0, 0.0)
    quat_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)

    def __post_init__(self):
        quat_xyzw = _vector("quat_xyzw", self.quat_xyzw, 4)
        _set(
            self,
            position=_vector("position", self.position),
            quat_xyzw=_unit("quat_xyzw", quat_xyzw),
        )


@dataclass(frozen=True)
class Sphere:
    """A ball about the origin; a disc in 2D. Radius [m]."""

    radius: float

    def __post_init__(self):
        _set(self, radius=_positive("radius", self.radius))


@dataclass(frozen=True)
class Box:
    """A box along the axes, given by its corners `min` and `max` or, centred, by its `size` [m].

    After construction all three fields hold.
    """

    min: Vector | None = None
    max: Vector | None = None
    size: Vector | None = None

    def __post_init__(self):
        lower, upper = self._corners()
        for axis, name in enumerate("xyz"):
            if not lower[axis] < upper[axis]:
                raise ValueError(
                    f"box: expected min < max along {name}, got {lower[axis]} and {upper[axis]}"
                )
        size = tuple(b - a for a, b in zip(lower, upper, strict=True))
        _set(self, min=lower, max=upper, size=size)

    def _corners(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        corners_given = self.min is not None and self.max is not None
        if corners_given:
            lower, upper = _vector("min", self.min), _vector("max", self.max)
            if self.size is None or _vector("size", self.size) == tuple(
                b - a for a, b in zip(lower, upper, strict=True)
            ):
                return lower, upper
        if self.size is None or self.min is not None or self.max is not None:
            raise ValueError(
                "box: expected either min and max or size alone, "
                f"got min={self.min!r}, max={self.max!r}, size={self.size!r}"
            )
        size = tuple(_positive(f"size[{i}]", v) for i, v in enumerate(_vector("size", self.size)))
        return tuple(-0.5 * v for v in size), tuple(0.5 * v for v in size)


@dataclass(frozen=True)
class Capsule:
    """A cylinder with round ends about the z axis, centred on the origin.

    Attributes:
        radius: of the cylinder and of the ends [m].
        length: between the centres of the two ends [m]; 0 makes a ball.
    """

    radius: float
    length: float

    def __post_init__(self):
        _set(
            self,
            radius=_positive("radius", self.radius),
            length=_not_negative("length", self.length),
        )


@dataclass(frozen=True)
class Cylinder:
    """A cylinder with flat ends about the z axis, centred on the origin; radius and length [m]."""

    radius: float
    length: float

    def __post_init__(self):
        _set(
            self,
            radius=_positive("radius", self.radius),
            length=_positive("length", self.length),
        )


@dataclass(frozen=True)
class Plane:
    """A half space: the material is where normal . point < offset.

    Attributes:
        normal: out of the material, normalised on construction.
        offset: signed distance of the plane from the origin along the normal [m].
    """

    normal: Vector = (0.0, 0.0, 1.0)
    offset: float = 0.0

    def __post_init__(self):
        normal = _unit("normal", _vector("normal", self.normal))
        _set(self, normal=normal, offset=_number("offset", self.offset))


@dataclass(frozen=True)
class Mesh:
    """A watertight or nearly watertight triangle mesh from a file.

    Attributes:
        file: path of an OBJ, STL, PLY, GLB or DAE file; read when the shape is first used.
        scale: metres per unit of the file, e.g. 0.001 for a file in millimetres.
    """

    file: str
    scale: float = 1.0

    def __post_init__(self):
        if not str(self.file).strip():
            raise ValueError(f"file: expected the path of a mesh, got {self.file!r}")
        _set(self, file=str(self.file), scale=_positive("scale", self.scale))


@dataclass(frozen=True)
class Placed:
    """A shape somewhere in the frame of the shape it is part of."""

    shape: "Shape"
    pose: Pose = Pose()

    def __post_init__(self):
        if not isinstance(self.shape, SHAPES):
            raise ValueError(f"shape: expected a shape, got {self.shape!r}")
        if not isinstance(self.pose, Pose):
            raise ValueError(f"pose: expected a Pose, got {self.pose!r}")


def _parts(name: str, parts, least: int) -> tuple[Placed, ...]:
    if isinstance(parts, (Placed, *SHAPES)) or not hasattr(parts, "__iter__"):
        raise ValueError(f"{name}: expected a list of shapes, got {parts!r}")
    parts = tuple(part if isinstance(part, Placed) else Placed(part) for part in parts)
    if len(parts) < least:
        raise ValueError(f"{name}: expected at least {least} shapes, got {len(parts)}")
    return parts


@dataclass(frozen=True)
class Union:
    """All points inside any of the parts."""

    of: tuple[Placed, ...]

    def __post_init__(self):
        _set(self, of=_parts("union", self.of, 1))


@dataclass(frozen=True)
class Difference:
    """All points inside the first part and in none of the others."""

    of: tuple[Placed, ...]

    def __post_init__(self):
        _set(self, of=_parts("difference", self.of, 2))


@dataclass(frozen=True)
class Container:
    """A shape inside out: the material is everywhere but inside `shape`, the liquid is inside."""

    shape: "Shape"

    def __post_init__(self):
        if not isinstance(self.shape, SHAPES):
            raise ValueError(f"container: expected a shape, got {self.shape!r}")


Shape = Sphere | Box | Capsule | Cylinder | Plane | Mesh | Union | Difference | Container
SHAPES = (Sphere, Box, Capsule, Cylinder, Plane, Mesh, Union, Difference, Container)
