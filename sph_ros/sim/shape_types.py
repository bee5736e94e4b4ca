# SPDX-License-Identifier: Apache-2.0
"""What solids are made of: frozen shapes, each in a frame of its own, lengths in metres.

Every shape checks itself on construction and raises ValueError naming the field, the value and what
was expected, so that code further in need not ask again.
"""

from dataclasses import dataclass

from sph_ros.sim.quantities import (
    Quaternion,
    Vector,
    check_quantities,
    quantity,
    replace_fields,
    unit_vector,
)


@dataclass(frozen=True)
class Pose:
    """Where a frame sits in its parent: parent_point = rotate(quat_xyzw, point) + position.

    Attributes:
        position: origin of the frame [m].
        quat_xyzw: orientation, normalised on construction; a zero quaternion is refused.
    """

    position: Vector = quantity("m", (0.0, 0.0, 0.0))
    quat_xyzw: Quaternion = quantity("1", (0.0, 0.0, 0.0, 1.0))

    def __post_init__(self):
        check_quantities(self)
        replace_fields(self, quat_xyzw=unit_vector("quat_xyzw", self.quat_xyzw))


@dataclass(frozen=True)
class Sphere:
    """A ball about the origin; a disc in 2D. Radius [m]."""

    radius: float = quantity("m", above=0.0)

    def __post_init__(self):
        check_quantities(self)


@dataclass(frozen=True)
class Box:
    """A box along the axes, given by its corners `min` and `max` or, centred, by its `size` [m].

    After construction all three fields hold.
    """

    min: Vector | None = quantity("m", None)
    max: Vector | None = quantity("m", None)
    size: Vector | None = quantity("m", None, above=0.0)

    def __post_init__(self):
        check_quantities(self)
        lower, upper = self._corners()
        for axis, name in enumerate("xyz"):
            if not lower[axis] < upper[axis]:
                raise ValueError(
                    f"box: expected min < max along {name}, got {lower[axis]} and {upper[axis]}"
                )
        replace_fields(self, min=lower, max=upper, size=_difference(upper, lower))

    def _corners(self) -> tuple[Vector, Vector]:
        if self.min is not None and self.max is not None:
            if self.size is None or self.size == _difference(self.max, self.min):
                return self.min, self.max
        if self.size is None or self.min is not None or self.max is not None:
            raise ValueError(
                "box: expected either min and max or size alone, "
                f"got min={self.min!r}, max={self.max!r}, size={self.size!r}"
            )
        return tuple(-0.5 * v for v in self.size), tuple(0.5 * v for v in self.size)


def _difference(a: Vector, b: Vector) -> Vector:
    return tuple(x - y for x, y in zip(a, b, strict=True))


@dataclass(frozen=True)
class Capsule:
    """A cylinder with round ends about the z axis, centred on the origin.

    Attributes:
        radius: of the cylinder and of the ends [m].
        length: between the centres of the two ends [m]; 0 makes a ball.
    """

    radius: float = quantity("m", above=0.0)
    length: float = quantity("m", low=0.0)

    def __post_init__(self):
        check_quantities(self)


@dataclass(frozen=True)
class Cylinder:
    """A cylinder with flat ends about the z axis, centred on the origin; radius and length [m]."""

    radius: float = quantity("m", above=0.0)
    length: float = quantity("m", above=0.0)

    def __post_init__(self):
        check_quantities(self)


@dataclass(frozen=True)
class Plane:
    """A half space: the material is where normal . point < offset.

    Attributes:
        normal: out of the material, normalised on construction.
        offset: signed distance of the plane from the origin along the normal [m].
    """

    normal: Vector = quantity("1", (0.0, 0.0, 1.0))
    offset: float = quantity("m", 0.0)

    def __post_init__(self):
        check_quantities(self)
        replace_fields(self, normal=unit_vector("normal", self.normal))


@dataclass(frozen=True)
class Mesh:
    """A watertight or nearly watertight triangle mesh from a file.

    Attributes:
        file: path of an OBJ, STL, PLY, GLB or DAE file; read when the shape is first used.
        scale: metres per unit of the file, e.g. 0.001 for a file in millimetres.
    """

    file: str
    scale: float = quantity("m per unit of the file", 1.0, above=0.0)

    def __post_init__(self):
        check_quantities(self)
        if not str(self.file).strip():
            raise ValueError(f"file: expected the path of a mesh, got {self.file!r}")
        replace_fields(self, file=str(self.file))


@dataclass(frozen=True)
class OpenSurface:
    """Triangles that need not enclose anything: a wall with two sides and no inside, 3D only.

    Attributes:
        file: as for `Mesh`; broken faces are dropped.
        scale: metres per unit of the file.
        close_holes: holes with at most so many edges are closed, 0 for none.
        restitution: speed after a particle met it over speed before, along the normal [-].
        friction: speed that a particle loses along it, over speed that it loses or turns around
            along the normal [-].
    """

    file: str
    scale: float = quantity("m per unit of the file", 1.0, above=0.0)
    close_holes: int = quantity("edges", 6, low=0, high=1e6)
    restitution: float = quantity("1", 0.0, low=0.0, high=1.0)
    friction: float = quantity("1", 0.0, low=0.0, high=10.0)

    def __post_init__(self):
        check_quantities(self)
        if not str(self.file).strip():
            raise ValueError(f"file: expected the path of a mesh, got {self.file!r}")
        replace_fields(self, file=str(self.file), close_holes=int(self.close_holes))


@dataclass(frozen=True)
class Placed:
    """A shape somewhere in the frame of the shape it is part of."""

    shape: "Shape"
    pose: Pose = Pose()

    def __post_init__(self):
        if not isinstance(self.shape, BODIES):
            raise ValueError(f"shape: expected a shape with an inside, got {self.shape!r}")
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
        replace_fields(self, of=_parts("union", self.of, 1))


@dataclass(frozen=True)
class Difference:
    """All points inside the first part and in none of the others."""

    of: tuple[Placed, ...]

    def __post_init__(self):
        replace_fields(self, of=_parts("difference", self.of, 2))


@dataclass(frozen=True)
class Container:
    """A shape inside out: the material is everywhere but inside `shape`, the liquid is inside."""

    shape: "Shape"

    def __post_init__(self):
        if not isinstance(self.shape, BODIES):
            raise ValueError(f"container: expected a shape with an inside, got {self.shape!r}")


#: What has an inside.
BODIES = (Sphere, Box, Capsule, Cylinder, Plane, Mesh, Union, Difference, Container)
Body = Sphere | Box | Capsule | Cylinder | Plane | Mesh | Union | Difference | Container

SHAPES = (*BODIES, OpenSurface)
Shape = Body | OpenSurface
