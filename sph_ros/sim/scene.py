# SPDX-License-Identifier: Apache-2.0
"""Scenes: YAML files or dicts in, checked frozen dataclasses out."""

import logging
import math
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sph_ros.sim.abilities import SOLVERS
from sph_ros.sim.jets import ENDLESS, capacity, make_jet
from sph_ros.sim.kernels import ensure_compiled, needs
from sph_ros.sim.liquid import (
    BYTES_PER_PARTICLE,
    available_memory,
    distances_to,
    estimated_particle_count,
    fill_liquid,
    lattice_counts,
)
from sph_ros.sim.mass import mass_properties
from sph_ros.sim.materials import MATERIALS, Material
from sph_ros.sim.scene_types import Emitter, Keyframe, LiquidBlock, Scene, Sink, SolidSpec
from sph_ros.sim.scene_yaml import Node, SceneError, build, check_keys, nearest, read_dict
from sph_ros.sim.scene_yaml import read_file as read_yaml
from sph_ros.sim.shapes import (
    Box,
    Capsule,
    Container,
    Cylinder,
    Difference,
    Mesh,
    OpenSurface,
    Placed,
    Plane,
    Pose,
    Sphere,
    Union,
)
from sph_ros.sim.share import share_folder

__all__ = [
    "SOLVERS",
    "Emitter",
    "Keyframe",
    "LiquidBlock",
    "Material",
    "Scene",
    "SceneError",
    "Sink",
    "SolidSpec",
    "bag_path",
    "fill_liquid",
    "list_scenes",
    "load_scene",
    "scene_path",
]

_LOG = logging.getLogger(__name__)

#: Liquid farther from the origin moves in steps that one sees: 6e-8 of the distance is 3e-4 of a
#: spacing here.
FARTHEST_SPACINGS = 5_000

# ---------------------------------------------------------------- finding


def list_scenes():
    """Names of the packaged scenes."""
    return sorted(path.stem for path in (share_folder() / "scenes").glob("*.yaml"))


def scene_path(name):
    """File of a packaged scene.

    Raises:
        SceneError: there is no such scene; the text names the nearest.
    """
    if name not in list_scenes():
        raise SceneError(f"no packaged scene {name!r}{nearest(name, list_scenes())}")
    return share_folder() / "scenes" / f"{name}.yaml"


def bag_path(name):
    """A recorded bag: `name` itself if it is a path that exists, else the packaged bag.

    Raises:
        SceneError: neither; the text names the nearest packaged bag.
    """
    if Path(name).exists():
        return Path(name)
    folder = share_folder() / "scenes" / "bags"
    packaged = sorted(path.parent.name for path in folder.glob("*/metadata.yaml"))
    if str(name) not in packaged:
        raise SceneError(f"{name}: no such bag{nearest(str(name), packaged)}")
    return folder / str(name)


def _find(source):
    """Path of a scene given as packaged name or as path."""
    text = os.fspath(source)
    path = Path(text)
    if path.suffix in (".yaml", ".yml") or path.name != text or path.is_file():
        if not path.exists():
            raise SceneError(f"{path}: no such file{nearest(path.stem, list_scenes())}")
        return path
    return scene_path(text)


# ---------------------------------------------------------------- loading


def load_scene(source):
    """A checked scene.

    Args:
        source: name of a packaged scene, path of a YAML file, or a dict with the same keys. Mesh
            files are relative to the YAML file, in a dict to the working directory.

    Returns:
        The Scene.

    Raises:
        SceneError: anything is wrong; one line that names file, line, key and what was expected.
    """
    if isinstance(source, Scene):
        return source
    if isinstance(source, Mapping):
        root, folder, name = read_dict(source), Path.cwd(), "scene"
    elif isinstance(source, (str, os.PathLike)):
        path = _find(source)
        root, folder, name = read_yaml(path), path.resolve().parent, path.stem
    else:
        raise SceneError(f"expected a scene's name, file or dict, got {type(source).__name__}")
    scene = _read_scene(root, folder, name)
    _check_amount(scene, root)
    _check_solids(scene, root)
    _check_openings(scene, root)
    return scene


def _read_scene(root: Node, folder: Path, name: str) -> Scene:
    if not {"liquid", "emitters"} & set(root.mapping()):
        raise root.error("expected liquid or emitters, got neither; `liquid: []` if none is meant")
    extra = {"source": root.where.rsplit(":", 1)[0]}
    if "name" not in root.mapping():
        extra["name"] = name
    readers = {
        "material": _read_material,
        "liquid": lambda node: tuple(_read_liquid(item) for item in node.items()),
        "emitters": lambda node: tuple(_read_emitter(item) for item in node.items()),
        "sinks": lambda node: tuple(_read_sink(item) for item in node.items()),
        "solids": lambda node: tuple(_read_solid(item, folder) for item in node.items()),
        "time_step": _read_auto,
        "support_radius": _read_auto,
    }
    return build(Scene, _without(root, set(extra) & {"name"}), readers, extra=extra)


def _without(node: Node, keys) -> Node:
    return Node({k: v for k, v in node.mapping().items() if k not in keys}, node.key, node.where)


def _read_auto(node: Node):
    """A number, or None for `auto`."""
    if node.value == "auto":
        return None
    if isinstance(node.value, str):
        raise node.error(f"expected auto or a number in SI units, got {node.value!r}")
    return node.plain()


def _read_material(node: Node) -> Material:
    """A packaged material by name, or a mapping: `base` or `name` of one, and what differs."""
    if isinstance(node.value, str):
        return _material(node, node.value)
    children = dict(node.mapping())
    start = children.pop("base", None)
    if start is None and isinstance(getattr(children.get("name"), "value", None), str):
        start = children["name"] if children["name"].value in MATERIALS else None
    base = _material(start, start.text()) if start else Material()
    extra = {key: value for key, value in vars(base).items() if key not in children}
    check_keys(node, [*vars(base), "base"])
    return build(
        Material,
        Node(children, node.key, node.where),
        {"name": Node.text},
        extra=extra,
    )


def _material(node: Node, name: str) -> Material:
    if name not in MATERIALS:
        raise node.error(f"unknown material {name!r}{nearest(name, MATERIALS)}")
    return MATERIALS[name]


def _read_pose(node: Node) -> Pose:
    return build(Pose, node)


def _read_emitter(node: Node) -> Emitter:
    return build(Emitter, node, renamed={"from_time": "from"})


def _read_sink(node: Node) -> Sink:
    shape = _read_shape(node, SINK_KEYS, None)
    rest = _without(node, SINK_KEYS)
    renamed = {"from_time": "from"}
    return build(Sink, rest, {"pose": _read_pose}, renamed=renamed, extra={"shape": shape})


def _read_liquid(node: Node) -> LiquidBlock:
    shape = _read_shape(node, LIQUID_KEYS, None)
    readers = {"pose": _read_pose, "material": _read_material}
    return build(LiquidBlock, _without(node, LIQUID_KEYS), readers, extra={"shape": shape})


def _read_solid(node: Node, folder: Path) -> SolidSpec:
    shape = _read_shape(node, SHAPE_KEYS, folder)
    readers = {
        "pose": _read_pose,
        "path": lambda path: tuple(build(Keyframe, item) for item in path.items()),
    }
    return build(SolidSpec, _without(node, SHAPE_KEYS), readers, extra={"shape": shape})


# ---------------------------------------------------------------- shapes


def _read_shape(node: Node, kinds, folder):
    """The one shape of a mapping that may have other keys beside it."""
    children = node.mapping()
    given = [kind for kind in kinds if kind in children]
    if len(given) > 1:
        raise children[given[1]].error(f"a second shape; the first is {given[0]!r}")
    if not given:
        stranger = next(iter(set(children) & set(SHAPE_KEYS)), None)
        if stranger:
            raise children[stranger].error(f"expected one of {', '.join(kinds)}")
        raise node.error(f"expected a shape, one of {', '.join(kinds)}; got {node.describe()}")
    return SHAPE_KEYS[given[0]](children[given[0]], folder)


def _primitive(cls):
    return lambda node, folder: build(cls, node)


def _mesh_file(cls):
    """Reader of a shape with a file, which is relative to the scene's folder."""

    def read(node: Node, folder: Path):
        file = node.mapping().get("file")
        if file is not None:
            path = folder / file.text()
            if not path.is_file():
                raise file.error(f"no such mesh file: {path}")
        return build(cls, node, {"file": lambda child: str(folder / child.text())})

    return read


def _read_container(node: Node, folder: Path) -> Container:
    check_keys(node, SHAPE_KEYS)
    return _checked(node, lambda: Container(_read_shape(node, SHAPE_KEYS, folder)))


def _parts(cls):
    """Reader of a union or difference: a list of shapes, each with an optional pose."""

    def read(node: Node, folder: Path):
        if isinstance(node.value, dict):  # written with the field's name
            check_keys(node, ["of"])
        items = node.value["of"] if isinstance(node.value, dict) and node.value else node
        parts = []
        for item in items.items():
            shape = _read_shape(item, SHAPE_KEYS, folder)
            rest = _without(item, SHAPE_KEYS)
            parts.append(build(Placed, rest, {"pose": _read_pose}, extra={"shape": shape}))
        return _checked(node, lambda: cls(tuple(parts)))

    return read


def _checked(node: Node, make):
    try:
        return make()
    except SceneError:
        raise
    except ValueError as error:
        raise node.error(str(error)) from None


SHAPE_KEYS = {
    "sphere": _primitive(Sphere),
    "box": _primitive(Box),
    "capsule": _primitive(Capsule),
    "cylinder": _primitive(Cylinder),
    "plane": _primitive(Plane),
    "mesh": _mesh_file(Mesh),
    "surface": _mesh_file(OpenSurface),
    "union": _parts(Union),
    "difference": _parts(Difference),
    "container": _read_container,
}
LIQUID_KEYS = ("box", "sphere", "cylinder", "capsule")
SINK_KEYS = (*LIQUID_KEYS, "plane")


# ---------------------------------------------------------------- whole scene


def _check_amount(scene: Scene, root: Node) -> None:
    """Refuse blocks smaller than a particle, and more particles than fit into memory."""
    for index, block in enumerate(scene.liquid):
        if lattice_counts(block.shape, scene).min() < 1:
            raise _item(root, "liquid", index).error(
                f"smaller than one particle (spacing {scene.spacing:g} m); lengths are in metres"
            )
    _check_emitters(scene, root)
    count = capacity(scene, estimated_particle_count(scene))
    needed, available = count * BYTES_PER_PARTICLE, available_memory()
    if needed > available or count > 2**31 - 1:
        children = root.mapping()
        raise children.get("spacing", root).error(
            f"{scene.spacing:g} m makes about {count:,.0f} particles, which need "
            f"{needed / 1e9:,.1f} GB of memory; {available / 1e9:,.1f} GB is available"
        )


def _check_emitters(scene: Scene, root: Node) -> None:
    """Refuse jets that cannot be, and say how many particles an endless one makes at most."""
    for index, emitter in enumerate(scene.emitters):
        node = _item(root, "emitters", index)
        try:
            make_jet(emitter, scene)
        except ValueError as error:
            key, _, text = str(error).partition(": ")
            raise node.mapping().get(key, node).error(text) from None
        endless = emitter.limit is None and emitter.until == math.inf
        if endless and scene.max_particles is None:
            _LOG.warning(
                "%s: %s: neither limit nor until: waits where there are %s particles more than at "
                "the start; max_particles sets another number",
                node.where,
                node.key,
                f"{ENDLESS:,}",
            )


def _check_openings(scene: Scene, root: Node) -> None:
    """Refuse emitters that lie inside a fixed solid: nothing would ever come out."""
    for index, emitter in enumerate(scene.emitters):
        places = make_jet(emitter, scene).places
        for solid in scene.solids:
            distance = distances_to(solid.shape, solid.pose, places, scene)
            if solid.control == "fixed" and (distance < 0.0).all():
                raise _item(root, "emitters", index).error(
                    f"the opening lies inside solid {solid.name!r}"
                )


def _check_solids(scene: Scene, root: Node) -> None:
    """Refuse meshes that cannot be used, and liquid that starts inside a solid."""
    ensure_compiled(needs(scene))
    positions, _ = fill_liquid(scene)
    if scene.liquid and not len(positions):
        raise _item(root, "liquid", 0).error("holds no particle")
    farthest = float(np.abs(positions).max(initial=0.0))
    if farthest > FARTHEST_SPACINGS * scene.spacing:
        raise _item(root, "liquid", 0).error(
            f"lies {farthest:.4g} m from the origin, expected at most "
            f"{FARTHEST_SPACINGS * scene.spacing:.4g} m ({FARTHEST_SPACINGS:,} spacings): "
            "positions are single precision numbers"
        )
    for index, solid in enumerate(scene.solids):
        node = _item(root, "solids", index)
        distance = _checked(node, lambda s=solid: distances_to(s.shape, s.pose, positions, scene))
        inside = distance < -0.5 * scene.spacing
        if inside.any():
            deepest = int(np.argmin(distance))
            place = [round(float(x), 4) for x in positions[deepest]]
            raise node.error(
                f"solid {solid.name!r} overlaps the liquid: {int(inside.sum())} of "
                f"{len(positions)} particles start inside it, the deepest by "
                f"{-distance[deepest]:.4g} m at {place}"
            )
        if solid.control == "free":
            weigh = (solid.shape, scene.dimension, solid.density, solid.mass)
            _checked(node, lambda w=weigh: mass_properties(*w))


def _item(root: Node, key: str, index: int) -> Node:
    return root.mapping()[key].items()[index]
