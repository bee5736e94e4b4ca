# SPDX-License-Identifier: Apache-2.0
"""A whole simulation in one file: numpy's npz with the scene in it as JSON."""

import dataclasses
import json
import os
import zipfile
from pathlib import Path

import numpy as np

from sph_ros.sim import scene_types, shape_types
from sph_ros.sim.materials import Material
from sph_ros.sim.state import EXTRA

FORMAT = 1

_CLASSES = {
    cls.__name__: cls
    for cls in (
        *shape_types.SHAPES,
        shape_types.Pose,
        shape_types.Placed,
        scene_types.LiquidBlock,
        scene_types.Emitter,
        scene_types.Sink,
        scene_types.Keyframe,
        scene_types.SolidSpec,
        scene_types.Scene,
        Material,
    )
}


class SnapshotError(ValueError):
    """A file is no snapshot of a simulation."""


def encode(value):
    """A scene, or a part of it, as plain lists, dicts, numbers and words for JSON."""
    if dataclasses.is_dataclass(value):
        fields = {
            f.name: encode(getattr(value, f.name)) for f in dataclasses.fields(value) if f.init
        }
        return {"class": type(value).__name__, **fields}
    if isinstance(value, (list, tuple)):
        return [encode(item) for item in value]
    return value


def decode(value):
    """Inverse of `encode`; every object checks itself again on construction."""
    if isinstance(value, dict):
        fields = {key: decode(item) for key, item in value.items() if key != "class"}
        return _CLASSES[value["class"]](**fields)
    if isinstance(value, list):
        return tuple(decode(item) for item in value)
    return value


def write_snapshot(path, scene, material, arrays, numbers):
    """Write atomically: a file that is there is whole.

    Args:
        path: of the file; `.npz` is not added.
        scene: `Scene`.
        material: the present `Material`.
        arrays: name -> array.
        numbers: JSON-able facts.
    """
    path = Path(path)
    facts = {"format": FORMAT, "scene": encode(scene), "material": encode(material), **numbers}
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(draft, "wb") as file:
            np.savez(file, facts=np.array(json.dumps(facts)), **arrays)
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


def _check_arrays(path, arrays):
    """Refuse arrays that are missing, cut off or of another kind."""
    count = len(arrays["particle"])
    wanted = {
        "positions": ("float32", (count, 3)),
        "velocities": ("float32", (count, 3)),
        "pressures": ("float32", (count,)),
        "densities": ("float32", (count,)),
        "particle": ("int32", (count,)),
        "ids": ("uint32", (count,)),
    }
    for name, (kind, shape) in wanted.items():
        rows = arrays[name]
        if rows.dtype != kind or rows.shape != shape:
            raise SnapshotError(
                f"{path}: {name}: expected {kind} {shape}, found {rows.dtype} {rows.shape}"
            )
    for name, rows in arrays.items():
        if name.startswith(EXTRA) and rows.shape[:1] != (count,):
            raise SnapshotError(f"{path}: {name}: expected {count} rows, found {rows.shape}")


def read_snapshot(path):
    """Scene, material, arrays and numbers of a snapshot.

    Raises:
        SnapshotError: it is missing, damaged or something else; names the file.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        facts = json.loads(str(arrays.pop("facts")))
        _check_arrays(path, arrays)
        if facts.pop("format") != FORMAT:
            raise SnapshotError(f"{path}: written by another version of sph_ros")
        return decode(facts.pop("scene")), decode(facts.pop("material")), arrays, facts
    except FileNotFoundError:
        raise SnapshotError(f"{path}: no such file") from None
    except SnapshotError:
        raise
    except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise SnapshotError(f"{path}: expected a snapshot of a simulation ({error})") from None
