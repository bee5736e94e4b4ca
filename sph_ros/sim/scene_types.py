# SPDX-License-Identifier: Apache-2.0
"""What a scene consists of: frozen dataclasses whose fields are the keys of a scene file.

SI units, z up. Every one checks its own values and raises ValueError("field: what is wrong").
"""

import math
import re
from dataclasses import dataclass, replace

from sph_ros.sim.abilities import MIXING_SOLVERS, SOLVERS, alike, faults
from sph_ros.sim.materials import Material
from sph_ros.sim.quantities import (
    Quaternion,
    Vector,
    check_quantities,
    quantity,
    replace_fields,
    unit_vector,
)
from sph_ros.sim.shapes import (
    Box,
    Capsule,
    Container,
    Cylinder,
    OpenSurface,
    Plane,
    Pose,
    Shape,
    Sphere,
)

#: A particle's liquid is one byte.
MOST_LIQUIDS = 16

#: Who moves a solid.
CONTROLS = ("fixed", "topic", "path", "free")

LIQUID_SHAPES = (Box, Sphere, Cylinder, Capsule)
SINK_SHAPES = (*LIQUID_SHAPES, Plane)

_TOPIC_TOKEN = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


@dataclass(frozen=True)
class LiquidBlock:
    """A piece of liquid at the start.

    Attributes:
        shape: what is filled; its own frame.
        pose: of the shape's frame in the scene's frame.
        velocity: of every particle [m/s], scene's frame.
        agitation: RMS of a random velocity along each axis, added to every particle's [m/s]; the
            same at every start.
        material: of this piece; None: the scene's.
        color: red, green, blue, 0 to 1; None: the material's.
        share: of its particles that are of that material; the others, strewn among them, are of the
            scene's: a mixture.
    """

    shape: Shape
    pose: Pose = Pose()
    velocity: Vector = quantity("m/s", (0.0, 0.0, 0.0), low=-100.0, high=100.0)
    agitation: float = quantity("m/s", 0.0, low=0.0, high=100.0)
    material: Material | None = None
    color: Vector | None = quantity("1", None, low=0.0, high=1.0)
    share: float = quantity("1", 1.0, low=0.0, high=1.0)

    def __post_init__(self):
        """Refuse shapes that hold no definite amount of liquid."""
        if not isinstance(self.shape, LIQUID_SHAPES):
            known = ", ".join(shape.__name__.lower() for shape in LIQUID_SHAPES)
            raise ValueError(f"shape: liquid can be a {known}; got {self.shape!r}")
        check_quantities(self)


@dataclass(frozen=True)
class Emitter:
    """A round opening (in 2D a slit) that liquid comes out of.

    With speed or rate alone the jet has rest density. With both, a rate below that makes single
    drops.

    Attributes:
        position: centre of the opening [m], scene's frame.
        direction: of the jet, normalised on construction.
        radius: of the opening, in 2D half its length [m].
        speed: of the liquid [m/s]; follows from `rate` unless given.
        rate: particles per second; follows from `speed` unless given.
        from_time: first moment [s]; key `from` in the file.
        until: last moment [s].
        limit: most particles it ever emits, None for no limit.
        nozzle: so far in front of the opening the liquid keeps the jet's speed, as it does in a
            narrow nozzle [m]; without one nothing holds a thick liquid that hangs from the opening.
    """

    position: Vector = quantity("m", low=-1e4, high=1e4)
    direction: Vector = quantity("1", (0.0, 0.0, -1.0), low=-1e9, high=1e9)
    radius: float = quantity("m", 0.01, above=0.0, high=100.0)
    speed: float | None = quantity("m/s", None, above=0.0, high=100.0)
    rate: float | None = quantity("particles/s", None, above=0.0, high=1e7)
    from_time: float = quantity("s", 0.0, low=0.0, high=1e9)
    until: float = quantity("s", math.inf, low=0.0)
    limit: int | None = quantity("particles", None, low=1, high=1e9)
    nozzle: float = quantity("m", 0.0, low=0.0, high=100.0)

    def __post_init__(self):
        """Refuse a jet without direction or strength, and one that never runs."""
        check_quantities(self)
        replace_fields(self, direction=unit_vector("direction", self.direction))
        if self.speed is None and self.rate is None:
            raise ValueError("speed: expected a speed [m/s] or a rate [particles/s], got neither")
        _check_times(self)
        if self.limit is not None:
            replace_fields(self, limit=int(self.limit))


@dataclass(frozen=True)
class Sink:
    """A region that takes away what gets into it.

    In a substep particles cross less than a support radius: a thinner region can be jumped over.

    Attributes:
        shape: of the region; its own frame.
        pose: of the shape's frame in the scene's frame.
        from_time: first moment [s]; key `from` in the file.
        until: last moment [s].
    """

    shape: Shape
    pose: Pose = Pose()
    from_time: float = quantity("s", 0.0, low=0.0, high=1e9)
    until: float = quantity("s", math.inf, low=0.0)

    def __post_init__(self):
        """Refuse shapes without an inside, and a sink that is never open."""
        if not isinstance(self.shape, SINK_SHAPES):
            known = ", ".join(shape.__name__.lower() for shape in SINK_SHAPES)
            raise ValueError(f"shape: a sink can be a {known}; got {self.shape!r}")
        check_quantities(self)
        _check_times(self)


def _check_times(item):
    if item.until <= item.from_time:
        raise ValueError(
            f"until: expected more than from ({item.from_time:g} s), got {item.until:g}"
        )


@dataclass(frozen=True)
class Keyframe:
    """Where a solid with `control: path` is at a time; between keyframes it sweeps.

    Attributes:
        time: since the start [s].
        position: [m], scene's frame.
        quat_xyzw: orientation, normalised on construction.
    """

    time: float = quantity("s", low=0.0, high=1e9)
    position: Vector = quantity("m", low=-1e4, high=1e4)
    quat_xyzw: Quaternion = quantity("1", (0.0, 0.0, 0.0, 1.0))

    def __post_init__(self):
        """Refuse what is no pose."""
        check_quantities(self)
        replace_fields(self, quat_xyzw=unit_vector("quat_xyzw", self.quat_xyzw))


@dataclass(frozen=True)
class SolidSpec:
    """A solid of the scene.

    Attributes:
        name: unique; part of topic names.
        shape: in the solid's own frame.
        pose: of the solid's frame in the scene's frame, at the start.
        control: "fixed", "topic" (pose messages, mouse, move_solid), "path" (keyframes) or "free"
            (a rigid body that the liquid, gravity and touches move).
        path: keyframes, for control "path".
        density: mass per volume [kg/m^3], for control "free"; or
        mass: of the whole solid, spread evenly over its volume [kg], in 2D per metre of depth.
        velocity: of the solid's origin at the start [m/s], for control "free".
        angular_velocity: at the start [rad/s], scene's frame, for control "free".
        friction: coefficient of friction with other solids; where two touch, the root of both
            counts.
        restitution: share of the speed that is left when a free solid bounces; the larger of two.
        color: red, green, blue, 0 to 1; chosen by whoever draws unless given.
        visible: drawn or not; it acts on the liquid either way.
        see_through: drawn as outlines, like glass, for what is in or behind it.
    """

    name: str
    shape: Shape
    pose: Pose = Pose()
    control: str = "fixed"
    path: tuple[Keyframe, ...] = ()
    density: float | None = quantity("kg/m^3", None, above=0.0, high=1e5)
    mass: float | None = quantity("kg", None, above=0.0, high=1e9)
    velocity: Vector = quantity("m/s", (0.0, 0.0, 0.0), low=-100.0, high=100.0)
    angular_velocity: Vector = quantity("rad/s", (0.0, 0.0, 0.0), low=-1000.0, high=1000.0)
    friction: float = quantity("1", 0.3, low=0.0, high=10.0)
    restitution: float = quantity("1", 0.0, low=0.0, high=1.0)
    color: Vector | None = quantity("1", None, low=0.0, high=1.0)
    visible: bool = True
    see_through: bool = False

    def __post_init__(self):
        """Refuse bad names, and keyframes that do not fit the control."""
        if not isinstance(self.name, str) or not _TOPIC_TOKEN.fullmatch(self.name):
            raise ValueError(
                "name: expected a letter, then letters, digits or _ (it becomes part of a topic), "
                f"got {self.name!r}"
            )
        if self.control not in CONTROLS:
            raise ValueError(f"control: expected one of {CONTROLS}, got {self.control!r}")
        for key in ("visible", "see_through"):
            if not isinstance(getattr(self, key), bool):
                raise ValueError(f"{key}: expected true or false, got {getattr(self, key)!r}")
        check_quantities(self)
        self._check_path()
        self._check_body()

    def _check_body(self):
        if self.density is not None and self.mass is not None:
            raise ValueError(
                f"mass: expected density or mass, got both ({self.density:g} kg/m^3, "
                f"{self.mass:g} kg)"
            )
        if self.control == "free":
            if self.density is None and self.mass is None:
                raise ValueError(
                    "density: expected a density [kg/m^3] or a mass [kg], because control is free; "
                    "got neither"
                )
            if isinstance(self.shape, Plane | Container | OpenSurface):
                kind = type(self.shape).__name__
                raise ValueError(f"control: a {kind} has no definite volume, so it cannot be free")
            return
        for field in ("velocity", "angular_velocity"):
            if any(getattr(self, field)):
                raise ValueError(
                    f"{field}: only a free solid starts with one, got control {self.control!r}"
                )

    def _check_path(self):
        times = [keyframe.time for keyframe in self.path]
        if self.control == "path" and not times:
            raise ValueError("path: expected keyframes, because control is path; got none")
        if times and self.control != "path":
            raise ValueError(f"path: keyframes need `control: path`, got control {self.control!r}")
        for index, (earlier, later) in enumerate(zip(times, times[1:], strict=False)):
            if later <= earlier:
                raise ValueError(
                    f"path[{index + 1}].time: expected more than {earlier:g} s, got {later:g}"
                )


@dataclass(frozen=True)
class Scene:
    """Everything a simulation starts from.

    Attributes:
        name: of the scene.
        spacing: of the particles [m].
        material: the liquid, where a piece of it names no other.
        frame: the frame that all positions are in; header.frame_id of the messages.
        dimension: 3, or 2: the liquid lives in the x-z plane.
        support_radius: radius of interaction [m]; None: twice the spacing.
        solver: one of SOLVERS.
        gravity: [m/s^2].
        time_step: [s]; None: chosen by the solver so that it is stable.
        liquid: at the start.
        emitters: of more liquid, later.
        sinks: where liquid leaves the scene.
        max_particles: there are never more at once, emitters wait; None: those of the start and all
            that the emitters can emit, 20,000 for one without limit and end.
        solids: in the order of the file.
        max_solid_speed: solids sweep towards their poses no faster than this [m/s].
        source: file the scene came from, or "<dict>".
        description: for people.
        duration: how long `sph_ros simulate` runs unless told [s]; None: 5.
    """

    name: str
    spacing: float = quantity("m", above=0.0, high=100.0)
    material: Material = Material()
    frame: str = "world"
    dimension: int = 3
    support_radius: float | None = quantity("m", None, above=0.0, high=400.0)
    solver: str = "relaxation"
    gravity: Vector = quantity("m/s^2", (0.0, 0.0, -9.81), low=-1000.0, high=1000.0)
    time_step: float | None = quantity("s", None, above=0.0, high=0.1)
    liquid: tuple[LiquidBlock, ...] = ()
    emitters: tuple[Emitter, ...] = ()
    sinks: tuple[Sink, ...] = ()
    max_particles: int | None = quantity("particles", None, low=1, high=1e9)
    solids: tuple[SolidSpec, ...] = ()
    max_solid_speed: float = quantity("m/s", 3.0, above=0.0, high=100.0)
    source: str = "<dict>"
    description: str = ""
    duration: float | None = quantity("s", None, above=0.0, high=1e6)

    def __post_init__(self):
        """Refuse what does not fit together."""
        check_quantities(self)
        self._check_words()
        if self.max_particles is not None:
            replace_fields(self, max_particles=int(self.max_particles))
        if self.support_radius is None:
            replace_fields(self, support_radius=2.0 * self.spacing)
        # With fewer neighbours a liquid at rest boils; with more, solids and corners blur.
        low, high = 1.6 * self.spacing, 4.0 * self.spacing
        if not low <= self.support_radius <= high:
            raise ValueError(
                f"support_radius: expected {low:g} to {high:g} m (1.6 to 4 spacings), "
                f"got {self.support_radius:g}"
            )
        self._check_names()

    @property
    def liquids(self):
        """Materials of the scene's liquids, one or more, each with its color.

        The first is `material`, and of that are emitted particles. Pieces of the same material and
        color are one liquid.
        """
        found = [self.material]
        for block in self.liquid:
            material = self._material_of(block)
            if material not in found:
                found.append(material)
        return tuple(found)

    @property
    def families(self):
        """Index into `liquids` of each piece in `liquid`."""
        liquids = self.liquids
        return tuple(liquids.index(self._material_of(block)) for block in self.liquid)

    def _material_of(self, block):
        material = block.material or self.material
        return material if block.color is None else replace(material, color=block.color)

    def _check_words(self):
        if self.solver not in SOLVERS:
            raise ValueError(f"solver: expected one of {SOLVERS}, got {self.solver!r}")
        self._check_liquids()
        if type(self.dimension) is not int or self.dimension not in (2, 3):
            raise ValueError(f"dimension: expected 2 or 3, got {self.dimension!r}")
        for key in ("name", "frame", "description"):
            if not isinstance(getattr(self, key), str):
                raise ValueError(f"{key}: expected text, got {getattr(self, key)!r}")
        if not self.frame or self.frame.startswith("/") or " " in self.frame:
            raise ValueError(f"frame: expected a frame id without / in front, got {self.frame!r}")

    def _check_liquids(self):
        for index, block in enumerate(self.liquid):
            other = block.material or self.material
            if not alike(other, self.material) and self.solver not in MIXING_SOLVERS:
                raise ValueError(
                    f"liquid[{index}].material: {other.name!r} beside {self.material.name!r}, and "
                    f"solver {self.solver!r} knows one material; {MIXING_SOLVERS} know several"
                )
        for field, fault in faults(self, self.liquids):
            raise ValueError(f"material.{field}: {fault}")
        if len(self.liquids) > MOST_LIQUIDS:
            raise ValueError(f"liquid: expected at most {MOST_LIQUIDS} liquids of different looks")

    def _check_names(self):
        seen = set()
        for index, solid in enumerate(self.solids):
            if solid.name in seen:
                raise ValueError(f"solids[{index}].name: {solid.name!r} is the name of two solids")
            seen.add(solid.name)
