# SPDX-License-Identifier: Apache-2.0
"""Mesh files: read by trimesh, checked, and sampled once into a distance grid kept on disk.

A mesh need not be watertight. It is refused when its surface does not say what is inside: points
just above and just below the surface are sampled, and more than `AMBIGUOUS_LIMIT` of them have a
generalized winding number that is neither near 0 nor near a whole body (0.25 < |w| < 0.75). It is
also refused when closing one hole takes more than `HOLE_LIMIT` of its area: a cup that is a single
sheet is no body. Other holes are closed by fans of triangles around their middles, with a warning.
"""

import hashlib
import logging
import os
import tempfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from sph_ros.core.mesh_distance import (
    build_cluster_tree,
    signed_distance_grid,
    winding_numbers,
)
from sph_ros.core.wall_tables import POWERS, flat_integral
from sph_ros.sim.shape_types import Mesh

#: Share of samples beside the surface that may be neither clearly inside nor clearly outside.
AMBIGUOUS_LIMIT = 0.05
#: Largest hole that is closed, as a share of the area of the mesh.
HOLE_LIMIT = 0.15
#: Nodes of a distance grid at most; beyond, its cells are larger than half the particle spacing.
MAX_GRID_NODES = 128**3
#: Triangles of a mesh at most: ten times what can be sampled within a minute.
MAX_TRIANGLES = 2_000_000

#: Nodes per support radius from where sums over nodes are as good as integrals.
FINE_STENCIL = 12

_SAMPLES = 2000
_GRID_VERSION = b"sph_ros distance grid 2"
_LOG = logging.getLogger(__name__)


class MeshError(ValueError):
    """A mesh file that cannot be used; the text names the file and the cause."""


@dataclass(frozen=True)
class Surface:
    """A checked mesh, holes closed.

    Attributes:
        vertices: [m], (V, 3) float64.
        triangles: vertex indices, (T, 3) int64.
        open_edges: edges that had a triangle on one side only, before the holes were closed.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    open_edges: int

    @property
    def corners(self) -> np.ndarray:
        """Corner points of all triangles [m], (T, 3, 3)."""
        return self.vertices[self.triangles]

    @property
    def bound(self) -> tuple[np.ndarray, float]:
        """Centre (3,) and radius [m] of a ball around the mesh."""
        centre = 0.5 * (self.vertices.min(axis=0) + self.vertices.max(axis=0))
        return centre, float(np.linalg.norm(self.vertices - centre, axis=1).max())


@dataclass(frozen=True)
class DistanceGrid:
    """Signed distance of a mesh, sampled.

    Attributes:
        origin: position of the first sample in the mesh's frame [m], (3,).
        cell: sample spacing [m].
        distance: signed distance [m], (nx, ny, nz) float32.
        ratio: wall share relative to a flat wall's at the same distance, density and near-density
            [-], (nx, ny, nz, 2) float32.
        bound: centre (3,) and radius [m] of a ball around the mesh.
    """

    origin: np.ndarray
    cell: float
    distance: np.ndarray
    ratio: np.ndarray
    bound: tuple[np.ndarray, float]


def read_mesh(path: Path, stream=None):
    """A trimesh object with all bodies of a file, or MeshError.

    Args:
        path: of the file; its ending says what kind it is.
        stream: its content, where that is not what is on the disk.
    """
    import trimesh  # slow to import, and many scenes have no mesh

    if not path.is_file():
        raise MeshError(f"{path}: no such mesh file")
    kind = path.suffix.lower().lstrip(".")
    if kind not in trimesh.available_formats():
        hint = " (install pycollada)" if kind == "dae" else ""
        raise MeshError(
            f"{path}: no reader for '{kind}' files{hint}; expected OBJ, STL, PLY or GLB"
        )
    try:
        source = path if stream is None else stream
        return trimesh.load(source, file_type=kind, force="mesh", process=False)
    except Exception as error:  # the readers raise whatever their parser runs into
        cause = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise MeshError(f"{path}: cannot be read as a mesh: {cause}") from error


def merged(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices at one place made one (files repeat them at seams); no collapsed triangles."""
    size = float(np.ptp(vertices, axis=0).max())
    keys = np.round((vertices - vertices.min(axis=0)) / max(size * 1e-7, 1e-30)).astype(np.int64)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    triangles = inverse.reshape(-1)[triangles]
    a, b, c = triangles.T
    return vertices[first], triangles[(a != b) & (b != c) & (c != a)]


def open_edges(triangles: np.ndarray) -> tuple[np.ndarray, bool]:
    """Directed edges that no other triangle runs along the other way, (E, 2).

    Also whether some triangles are wound against their neighbours.
    """
    edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    count = int(triangles.max()) + 1
    low, high = edges.min(axis=1), edges.max(axis=1)
    _, inverse = np.unique(low * count + high, return_inverse=True)
    balance = np.bincount(inverse, weights=np.where(edges[:, 0] == low, 1.0, -1.0))
    uses = np.bincount(inverse)
    # Two triangles wound against each other leave an imbalance of 2 but no hole.
    is_open = (uses % 2 == 1) & (np.abs(balance) == 1)
    return edges[is_open[inverse]], bool(((uses == 2) & (np.abs(balance) == 2)).any())


def _same_winding(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The triangles with neighbours wound alike, from body to body perhaps still inside out."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    trimesh.repair.fix_winding(mesh)
    return np.asarray(mesh.faces, dtype=np.int64)


def components(cells: np.ndarray, vertex_count: int) -> np.ndarray:
    """Number of the connected part each vertex is in, from edges (E, 2) or triangles (T, 3)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    start, end = cells[:, :-1].ravel(), cells[:, 1:].ravel()
    graph = coo_array((np.ones(len(start)), (start, end)), shape=(vertex_count,) * 2)
    return connected_components(graph, directed=False)[1]


def close_holes(vertices, triangles, edges):
    """Add a fan of triangles around the middle of each connected chain of open edges."""
    label = components(edges, len(vertices))
    _, hole = np.unique(label[edges[:, 0]], return_inverse=True)
    middles = np.stack(
        [
            np.bincount(hole, weights=vertices[edges, axis].mean(axis=1)) / np.bincount(hole)
            for axis in range(3)
        ],
        axis=1,
    )
    fans = np.stack([edges[:, 1], edges[:, 0], len(vertices) + hole], axis=1)
    return np.concatenate([vertices, middles]), np.concatenate([triangles, fans])


def ambiguous_share(corners: np.ndarray) -> float:
    """Share of points beside the surface with 0.25 < |winding number| < 0.75.

    Args:
        corners: of the triangles [m], (T, 3, 3). Points lie on both sides of random places, spread
            evenly over the area, one thousandth of the mesh's size away from it.
    """
    vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(vectors, axis=1)
    generator = np.random.default_rng(0)
    chosen = generator.choice(len(corners), _SAMPLES, p=area / area.sum())
    place = generator.dirichlet((1.0, 1.0, 1.0), _SAMPLES)
    points = (corners[chosen] * place[:, :, None]).sum(axis=1)
    offset = 1e-3 * float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    offset = offset * vectors[chosen] / area[chosen, None]
    beside = np.concatenate([points + offset, points - offset])
    winding = np.empty(len(beside))
    winding_numbers(build_cluster_tree(corners), beside, winding)
    return float(((np.abs(winding) > 0.25) & (np.abs(winding) < 0.75)).mean())


def load_surface(file: str, scale: float = 1.0) -> Surface:
    """Read and check a mesh file.

    Args:
        file: path of an OBJ, STL, PLY, GLB or (with pycollada) DAE file; all its bodies are taken.
        scale: metres per unit of the file.

    Raises:
        MeshError: the file is missing, unreadable, without triangles, too large, or its surface
            does not say what is inside.
    """
    path = Path(file)
    stamp = path.stat().st_mtime_ns if path.is_file() else 0
    return _load_surface(path, float(scale), stamp)


@lru_cache(maxsize=32)
def _load_surface(path: Path, scale: float, stamp: int) -> Surface:
    loaded = read_mesh(path)
    vertices = np.asarray(getattr(loaded, "vertices", ()), dtype=np.float64).reshape(-1, 3)
    triangles = np.asarray(getattr(loaded, "faces", ()), dtype=np.int64).reshape(-1, 3)
    _check_arrays(path, vertices, triangles)
    vertices, triangles = merged(vertices[np.unique(triangles)] * scale, compact(triangles))
    if not areas(vertices[triangles]).sum() > 1e-12 * np.ptp(vertices, axis=0).max() ** 2:
        raise MeshError(f"{path}: contains no triangles with an area")
    edges, mixed = open_edges(triangles)
    if mixed:
        triangles = _same_winding(vertices, triangles)
        edges, _ = open_edges(triangles)
    share = ambiguous_share(vertices[triangles])
    if share > AMBIGUOUS_LIMIT:
        raise MeshError(
            f"{path}: does not enclose a body: {len(edges)} open edges, {100 * share:.0f} % of the "
            f"surface has no clear inside; expected a watertight mesh or at most "
            f"{100 * AMBIGUOUS_LIMIT:.0f} %"
        )
    if len(edges):
        vertices, triangles = _closed(path, vertices, triangles, edges)
    return Surface(vertices, _outward(vertices, triangles), len(edges))


def _closed(path: Path, vertices, triangles, edges) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with its holes closed, or MeshError if one of them is too large."""
    count = len(triangles)
    closed_vertices, closed = close_holes(vertices, triangles, edges)
    area = areas(closed_vertices[closed])
    hole = closed[count:, 2] - len(vertices)
    holes = np.bincount(hole, weights=area[count:]) / area[:count].sum()
    if holes.max() > HOLE_LIMIT:
        raise MeshError(
            f"{path}: does not enclose a body: {len(edges)} open edges, the largest hole has "
            f"{100 * holes.max():.0f} % of the surface's area; expected a watertight mesh or "
            f"holes of at most {100 * HOLE_LIMIT:.0f} %"
        )
    _LOG.warning(
        "%s: not watertight, closed the holes of %d open edges (%.1f %% of the surface)",
        path,
        len(edges),
        100 * holes.sum(),
    )
    return closed_vertices, closed


def areas(corners: np.ndarray) -> np.ndarray:
    """Areas of triangles given by their corners (T, 3, 3)."""
    vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * np.linalg.norm(vectors, axis=1)


def _outward(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The triangles with every body wound so that normals point out of the material.

    A body is turned when only the front of its largest triangle is inside the mesh.
    """
    body = components(triangles, len(vertices))[triangles[:, 0]]
    corners = vertices[triangles]
    vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(vectors, axis=1)
    by_area = np.argsort(area, kind="stable")
    largest = np.zeros(body.max() + 1, dtype=np.int64)
    largest[body[by_area]] = by_area
    offset = 1e-4 * np.ptp(vertices, axis=0).max() / np.maximum(area[largest], 1e-300)
    middle, offset = corners[largest].mean(axis=1), offset[:, None] * vectors[largest]
    winding = np.empty(2 * len(largest))
    beside = np.concatenate([middle + offset, middle - offset])
    winding_numbers(build_cluster_tree(corners), beside, winding)
    front, back = np.abs(winding.reshape(2, -1)) >= 0.5
    return np.where((front & ~back)[body][:, None], triangles[:, ::-1], triangles)


def compact(triangles: np.ndarray) -> np.ndarray:
    """Triangles over their own vertices only, numbered in order."""
    return np.unique(triangles, return_inverse=True)[1].reshape(-1, 3)


def _check_arrays(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    if len(triangles) == 0:
        raise MeshError(f"{path}: contains no triangles")
    if len(triangles) > MAX_TRIANGLES:
        raise MeshError(f"{path}: {len(triangles)} triangles, expected at most {MAX_TRIANGLES}")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise MeshError(
            f"{path}: a triangle names vertex {int(triangles.max())}, but there are {len(vertices)}"
        )
    if not np.isfinite(vertices[np.unique(triangles)]).all():
        raise MeshError(f"{path}: a vertex is not a finite number")


def grid_layout(surface: Surface, support_radius: float, spacing: float):
    """Where a mesh is sampled: (origin (3,) [m], cell [m], nodes along x, y, z).

    Cells are half the particle spacing, finer for meshes of less than 24 cells, coarser where that
    would take more than MAX_GRID_NODES. The grid reaches the support radius beyond the mesh.
    """
    lower, upper = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    cell = min(0.5 * spacing, float((upper - lower).max()) / 24.0)
    while True:
        margin = support_radius + 1.5 * cell
        shape = np.ceil((upper - lower + 2.0 * margin) / cell).astype(int) + 1
        if shape.prod() <= MAX_GRID_NODES:
            break
        cell *= 1.02
    origin = 0.5 * (lower + upper) - 0.5 * cell * (shape - 1)
    return origin, cell, tuple(int(n) for n in shape)


def _support_stencil(support_radius: float, cell: float):
    """Offsets of a cube of nodes around the support (n, n, n, 3) and both weights (n, n, n, 2)."""
    reach = int(support_radius / cell)
    axis = np.arange(-reach, reach + 1)
    offsets = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    q = np.linalg.norm(offsets, axis=-1) * cell / support_radius
    weights = np.stack([np.maximum(1.0 - q, 0.0) ** power for power in POWERS], axis=-1)
    return offsets, weights


def _cover_sums(distance, cell, weights):
    """Weighted share of material around every node, (nx, ny, nz, 2); none outside the grid."""
    from scipy.signal import fftconvolve  # slow to import, and many scenes have no mesh

    cover = np.clip(0.5 - distance / cell, 0.0, 1.0)
    sums = [fftconvolve(cover, weights[..., channel], mode="same") for channel in range(2)]
    return np.maximum(np.stack(sums, axis=-1), 0.0)


def _flat_sums(offsets, weights, cell, support_radius):
    """`_cover_sums` of flat walls over their distance, mean over directions: (d, sums (D, 2))."""
    distance = np.linspace(-support_radius, support_radius, 129)
    if support_radius > FINE_STENCIL * cell:
        flat = flat_integral(distance, support_radius, 3)
        return distance, flat / flat[0] * weights.sum(axis=(0, 1, 2))
    inside = weights[..., 0] > 0.0
    offsets, weights = offsets[inside], weights[inside]
    index = np.arange(64) + 0.5  # Fibonacci directions
    z, turn = 1.0 - index / 32.0, index * np.pi * (1.0 + 5.0**0.5)
    flat = np.sqrt(1.0 - z * z)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
    heights = offsets @ directions.T
    sums = [
        np.einsum("kn,kp->p", np.clip(0.5 - d / cell - heights, 0.0, 1.0), weights)
        for d in distance
    ]
    return distance, np.array(sums) / len(directions)


def _wall_ratio(distance, cell: float, support_radius: float, inverted: bool) -> np.ndarray:
    """Material within the support relative to a flat wall at the same distance, (nx, ny, nz, 2).

    Args:
        distance: signed distance of the mesh at the nodes of its grid [m], (nx, ny, nz) float32.
        cell: spacing of the nodes [m].
        support_radius: h [m].
        inverted: the material is outside the mesh.
    """
    ratio = np.ones((*distance.shape, 2), dtype=np.float32)
    if support_radius < 2.0 * cell:
        return ratio  # too coarse to see edges: every wall counts as flat
    offsets, weights = _support_stencil(support_radius, cell)
    sums = _cover_sums(distance, cell, weights)
    at, flat = _flat_sums(offsets, weights, cell, support_radius)
    near = np.abs(distance) < support_radius
    for channel in range(2):
        total = float(weights[..., channel].sum())
        found, expected = sums[near, channel], np.interp(distance[near], at, flat[:, channel])
        if inverted:
            found, expected = total - found, total - expected
        # The small addition lets the ratio go to 1 where both sums vanish.
        ratio[near, channel] = (found + 1e-3 * total) / (expected + 1e-3 * total)
    return np.clip(ratio, 0.0, 2.0)


def _compute_grid(surface, support_radius, spacing, dimension, inverted) -> DistanceGrid:
    origin, cell, shape = grid_layout(surface, support_radius, spacing)
    band = min(max(support_radius, 2.0 * cell), 5.0 * cell)
    distance = signed_distance_grid(surface.corners, origin, cell, shape, band)
    if dimension == 2:
        ratio = np.ones((*shape, 2), dtype=np.float32)
    else:
        ratio = _wall_ratio(distance, cell, support_radius, inverted)
    return DistanceGrid(origin, cell, distance, ratio, surface.bound)


def cache_folder() -> Path:
    """Where distance grids are kept: below $XDG_CACHE_HOME, else ~/.cache."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "sph_ros" / "distance_grids"


def _cache_key(surface: Surface, *parameters) -> str:
    digest = hashlib.sha256(_GRID_VERSION)
    digest.update(np.ascontiguousarray(surface.vertices, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(surface.triangles, dtype="<i8").tobytes())
    digest.update(repr(parameters).encode())
    return digest.hexdigest()


def _read_cache(path: Path, shape: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray] | None:
    """Distance and ratio from a cache file; None where there is none or it is damaged."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            distance, ratio = stored["distance"], stored["ratio"]
    except FileNotFoundError:
        return None
    except Exception as error:  # zipfile, numpy and the OS each raise their own kinds
        _LOG.warning("%s: damaged cache file, sampling the mesh again: %s", path, error)
        return None
    good = distance.shape == shape and ratio.shape == (*shape, 2)
    good = good and distance.dtype == ratio.dtype == np.float32
    return (distance, ratio) if good and np.isfinite(distance).all() else None


def _write_cache(path: Path, grid: DistanceGrid) -> None:
    """Store a grid so that no reader ever sees half a file; no cache is no error."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, partial = tempfile.mkstemp(suffix=".part", dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez_compressed(file, distance=grid.distance, ratio=grid.ratio)
            os.replace(partial, path)
        except BaseException:
            os.unlink(partial)
            raise
    except OSError as error:
        _LOG.warning("%s: cannot keep the sampled mesh: %s", path, error)


def load_distance_grid(
    mesh: Mesh, support_radius: float, spacing: float, dimension: int, inverted: bool = False
) -> DistanceGrid:
    """The distance grid of a mesh file, from the user's cache if it was sampled before.

    Args:
        mesh: file and scale.
        support_radius: h [m]; the grid reaches this far beyond the mesh.
        spacing: of the particles [m].
        dimension: 3, or 2, where the wall counts as flat everywhere.
        inverted: the ratio is that of the space around the mesh; the distance is not inverted.

    Raises:
        MeshError: as `load_surface`.
    """
    surface = load_surface(mesh.file, mesh.scale)
    parameters = (float(support_radius), float(spacing), dimension, bool(inverted))
    path = cache_folder() / f"{_cache_key(surface, *parameters)}.npz"
    origin, cell, shape = grid_layout(surface, support_radius, spacing)
    stored = _read_cache(path, shape)
    if stored is not None:
        return DistanceGrid(origin, cell, *stored, surface.bound)
    grid = _compute_grid(surface, *parameters)
    _write_cache(path, grid)
    return grid
