# SPDX-License-Identifier: Apache-2.0
"""Open mesh files as sheets: read, mended where they are broken, sorted into grids.

Nothing is asked of such a mesh but triangles: each is a wall on both sides, so it does not matter
how they are wound. Faces that name vertices which do not exist are dropped, doubled and collapsed
ones too. Where that, or whoever made the file, left small holes, they are closed.
"""

import io
import logging
import re
from functools import lru_cache
from pathlib import Path

import numpy as np

from sph_ros.core.sheets import CORNERS, EDGES, Sheets, find_corners, list_triangles
from sph_ros.sim.meshes import (
    HOLE_LIMIT,
    MAX_TRIANGLES,
    MeshError,
    areas,
    close_holes,
    compact,
    components,
    merged,
    read_mesh,
)
from sph_ros.sim.shape_types import OpenSurface

#: Cells of a grid at most; beyond, they are larger than half the support radius.
MOST_CELLS = 2_000_000

_LOG = logging.getLogger(__name__)


def load_sheet(surface: OpenSurface) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m] and triangles (T, 3) of an open mesh, small holes closed.

    Raises:
        MeshError: the file is missing, unreadable or without triangles.
    """
    path = Path(surface.file)
    stamp = path.stat().st_mtime_ns if path.is_file() else 0
    return _load_sheet(path, surface.scale, surface.close_holes, stamp)


@lru_cache(maxsize=32)
def _load_sheet(path: Path, scale: float, most_edges: int, stamp: int):
    vertices, triangles, dropped = _read(path)
    if len(triangles) > MAX_TRIANGLES:
        raise MeshError(f"{path}: {len(triangles)} triangles, expected at most {MAX_TRIANGLES}")
    finite = np.isfinite(vertices).all(axis=1)
    good = finite[triangles].all(axis=1)
    dropped += int((~good).sum())
    if good.any():
        triangles = triangles[good]
        used = vertices[np.unique(triangles)] * scale
        vertices, triangles = merged(used, compact(triangles))
        triangles = _without_doubles(vertices, triangles)
    if not good.any() or not len(triangles):
        raise MeshError(f"{path}: contains no triangles with an area")
    count = len(triangles)
    vertices, triangles = _closed(vertices, triangles, most_edges)
    if dropped or len(triangles) > count:
        _LOG.warning(
            "%s: dropped %d faces that name no vertex, closed small holes with %d triangles",
            path,
            dropped,
            len(triangles) - count,
        )
    vertices.setflags(write=False)
    triangles.setflags(write=False)
    return vertices, triangles


def _read(path: Path):
    """Vertices, triangles, and how many faces had to be dropped because they name no vertex."""
    dropped = 0
    try:
        mesh = read_mesh(path)
    except MeshError:
        if path.suffix.lower() != ".obj" or not path.is_file():
            raise
        text, dropped = _mended_obj(path.read_text(encoding="utf-8", errors="replace"))
        if not dropped:
            raise
        mesh = read_mesh(path, io.BytesIO(text.encode()))
    vertices = np.asarray(getattr(mesh, "vertices", ()), dtype=np.float64).reshape(-1, 3)
    triangles = np.asarray(getattr(mesh, "faces", ()), dtype=np.int64).reshape(-1, 3)
    inside = ((triangles >= 0) & (triangles < len(vertices))).all(axis=1)
    return vertices, triangles[inside], dropped + int((~inside).sum())


def _mended_obj(text: str) -> tuple[str, int]:
    """An OBJ file's vertices and good faces, and how many faces were left out.

    Bad is what names a vertex that does not exist. Texture coordinates and normals go: they may be
    just as wrong, and a wall needs none.
    """
    lines, count, dropped = [], 0, 0
    total = len(re.findall(r"^\s*v\s", text, re.MULTILINE))
    for line in text.replace("\\\n", " ").splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            count += 1
            lines.append(line)
        elif words[:1] == ["f"]:
            face = [_vertex_number(word, count) for word in words[1:]]
            if len(face) >= 3 and all(1 <= number <= total for number in face):
                lines.append("f " + " ".join(map(str, face)))
            else:
                dropped += 1
    return "\n".join(lines) + "\n", dropped


def _vertex_number(word: str, count: int) -> int:
    """Vertex of a corner such as 3, 3/1/2 or -1 (the last of `count` so far); 0 if it is none."""
    try:
        number = int(word.split("/")[0])
    except ValueError:
        return 0
    return number if number >= 0 else count + 1 + number


def _without_doubles(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The triangles that have an area, each once, however its corners are ordered."""
    size = float(np.ptp(vertices, axis=0).max())
    triangles = triangles[areas(vertices[triangles]) > 1e-12 * size**2]
    _, first = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
    return triangles[np.sort(first)]


def _closed(vertices, triangles, most_edges):
    """The mesh with its holes closed that have at most so many edges and little area."""
    edges = open_sides(triangles)
    if not most_edges or not len(edges):
        return vertices, triangles
    filled, fans = close_holes(vertices, triangles, edges)
    fans = fans[len(triangles) :]
    middle, hole, size = np.unique(fans[:, 2], return_inverse=True, return_counts=True)
    # The outline of a plate is no hole in it.
    part = components(triangles, len(filled))
    whole = np.bincount(part[triangles[:, 0]], areas(vertices[triangles]), minlength=len(filled))
    missing = np.bincount(hole, areas(filled[fans]))
    around = np.zeros(len(middle), np.int64)
    around[hole] = part[fans[:, 0]]
    small = (size <= most_edges) & (missing < HOLE_LIMIT * whole[around])
    chosen = fans[small[hole]]
    both = np.concatenate([triangles, chosen])
    return filled[np.unique(both)], compact(both)


def open_sides(triangles: np.ndarray) -> np.ndarray:
    """Edges that belong to one triangle only, whichever way it is wound, (E, 2)."""
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, uses = np.unique(edges, axis=0, return_counts=True)
    return unique[uses == 1]


# ---------------------------------------------------------------- for the kernels


def pack_sheets(shapes, support_radius: float) -> Sheets:
    """The sheets among the shapes of all solids, for the compiled functions.

    Args:
        shapes: of the solids.
        support_radius: h [m].
    """
    sheet_of = np.full(len(shapes), -1, np.int32)
    parts, reach = [], float(support_radius)
    for index, shape in enumerate(shapes):
        if isinstance(shape, OpenSurface):
            sheet_of[index] = len(parts)
            parts.append(_sorted_sheet(shape, reach))
    columns = {name: [part[name] for part in parts] for name in (parts[0] if parts else ())}

    def stacked(name, kind, shape):
        return np.array(columns.get(name, []), kind).reshape(-1, *shape)

    def joined(name, kind, shape=()):
        empty = [np.empty((0, *shape), kind)]
        return np.concatenate(columns.get(name) or empty).astype(kind)

    triangle_counts = [len(rows) for rows in columns.get("corners", [])]
    entry_counts = [len(rows) for rows in columns.get("cell_triangles", [])]
    first_triangle = np.cumsum([0, *triangle_counts])
    first_entry = np.cumsum([0, *entry_counts])
    for rows, start in zip(columns.get("cell_triangles", []), first_triangle[:-1], strict=True):
        rows += start
    # Of each list of cells the last number is the first of the next list.
    starts = [
        rows[:-1] + start
        for rows, start in zip(columns.get("cell_start", []), first_entry[:-1], strict=True)
    ]
    cell_counts = [len(rows) for rows in starts]
    return Sheets(
        reach=np.float32(reach),
        solid=np.flatnonzero(sheet_of >= 0).astype(np.int32),
        sheet_of=sheet_of,
        lower=stacked("lower", np.float32, (3,)),
        inverse_cell=stacked("inverse_cell", np.float32, ()),
        counts=stacked("counts", np.int32, (3,)),
        first_cell=np.cumsum([0, *cell_counts])[:-1].astype(np.int64),
        cell_start=np.concatenate([*starts, first_entry[-1:]]).astype(np.int64),
        cell_triangles=joined("cell_triangles", np.int32),
        has_corner=joined("has_corner", bool),
        first_triangle=first_triangle.astype(np.int64),
        corners=joined("corners", np.float32, (3, 3)),
        normals=joined("normals", np.float32, (3,)),
        balls=joined("balls", np.float32, (4,)),
        open_parts=joined("open_parts", np.int32),
        bounce=stacked("bounce", np.float32, (2,)),
    )


def _sorted_sheet(shape: OpenSurface, reach: float) -> dict:
    """Fields of `Sheets` of one sheet, indices counted from its own first triangle."""
    vertices, triangles = load_sheet(shape)
    corners = np.ascontiguousarray(vertices[triangles], np.float32)
    exact = corners.astype(np.float64)
    normals = np.cross(exact[:, 1] - exact[:, 0], exact[:, 2] - exact[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals.astype(np.float32)
    middle = 0.5 * (exact.min(axis=1) + exact.max(axis=1))
    radius = np.linalg.norm(exact - middle[:, None], axis=2).max(axis=1, keepdims=True)
    lower, cell, counts = _layout(exact, reach)
    start = np.zeros(int(np.prod(counts, dtype=np.int64)) + 1, np.int64)
    entries = np.empty(0, np.int32)
    list_triangles(corners, normals, lower, cell, counts, reach, start, entries)
    if start[-1]:
        entries = np.empty(start[-1], np.int32)
        list_triangles(corners, normals, lower, cell, counts, reach, start, entries)
    has_corner = np.zeros(len(start) - 1, bool)
    find_corners(normals, start, entries, has_corner)
    return {
        "lower": lower,
        "inverse_cell": 1.0 / cell,
        "counts": counts,
        "cell_start": start,
        "cell_triangles": entries,
        "has_corner": has_corner,
        "corners": corners,
        "normals": normals,
        "balls": np.concatenate([middle, 1.0001 * radius], axis=1),
        "open_parts": _open_parts(triangles),
        "bounce": (shape.restitution, shape.friction),
    }


def _layout(corners: np.ndarray, reach: float):
    """Grid over triangles and what is near them: (lower (3,) [m], cell [m], counts (3,) int32)."""
    lower = corners.min(axis=(0, 1)) - 1.01 * reach
    extent = corners.max(axis=(0, 1)) + 1.01 * reach - lower
    cell = 0.5 * reach
    while np.prod(np.ceil(extent / cell)) > MOST_CELLS:
        cell *= 1.26
    return lower, cell, np.ceil(extent / cell).astype(np.int32)


def _open_parts(triangles: np.ndarray) -> np.ndarray:
    """For each triangle the bits of its edges and corners on the edge of the sheet, (T,) int32."""
    count = int(triangles.max()) + 1
    sides = open_sides(triangles)
    keys = np.unique(sides[:, 0] * count + sides[:, 1])
    rim = np.zeros(count, bool)
    rim[sides] = True
    bits = np.zeros(len(triangles), np.int32)
    for side in range(3):
        edge = np.sort(triangles[:, [side, (side + 1) % 3]], axis=1)
        bits |= EDGES[side] * np.isin(edge[:, 0] * count + edge[:, 1], keys).astype(np.int32)
        bits |= CORNERS[side] * rim[triangles[:, side]].astype(np.int32)
    return bits
