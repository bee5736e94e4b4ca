# SPDX-License-Identifier: Apache-2.0
"""What is tracked: single markers and boards, that is rigid sets of markers.

A marker's frame is OpenCV's: origin in its centre, x right, y up, z out of the paper. A board's
frame is whatever its markers are placed in. YAML of a boards file, lengths in metres:

    boards:
      wand:
        markers:
          - {id: 3, size: 0.04, position: [0, 0, 0.025]}
          - {id: 4, size: 0.04, position: [0.025, 0, 0], quat_xyzw: [0.5, 0.5, 0.5, 0.5]}
      table: {grid: {columns: 4, rows: 3, size: 0.04, gap: 0.01, first_id: 10}}
      sheet: {charuco: {columns: 7, rows: 5, square: 0.04, size: 0.03, first_id: 0}}
      cube:  {cube: {edge: 0.05, size: 0.04, ids: [5, 6, 7, 8, 9]}}
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from sph_ros.tracking.se3 import Pose, pose_from_quaternion

#: Corners of a marker of side 1 in its own frame, in the order in which OpenCV finds them.
UNIT_CORNERS = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])

#: Faces of a cube wand, in the order of its ids: top (+z), front (-y), right (+x), back (+y),
#: left (-x), bottom (-z). Columns of each matrix are the marker's x, y, z.
CUBE_FACES = np.array(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
        [[-1, 0, 0], [0, 0, 1], [0, 1, 0]],
        [[0, 0, -1], [-1, 0, 0], [0, 1, 0]],
        [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    ],
    float,
)


class TargetError(ValueError):
    """A description of markers is wrong; says which, and what was expected."""


@dataclass(frozen=True, eq=False)
class Target:
    """A marker, or several that are fixed to one another.

    Attributes:
        name: what its topics are called.
        corners: id -> corners (4, 3) [m] in the target's frame, in OpenCV's order.
    """

    name: str
    corners: dict

    def __post_init__(self):
        # Worked out once: they are asked for in every picture.
        object.__setattr__(self, "_poses", {i: _square_pose(c) for i, c in self.corners.items()})

    @property
    def ids(self):
        """Its markers' ids."""
        return tuple(self.corners)

    def points(self, ids):
        """Corners (4 len(ids), 3) [m] of some of its markers."""
        return np.concatenate([self.corners[i] for i in ids])

    def marker_pose(self, marker_id):
        """target_from_marker."""
        return self._poses[marker_id]

    def square(self, marker_id):
        """Corners (4, 3) [m] of a marker in its own frame."""
        return self.marker_size(marker_id) * UNIT_CORNERS

    def marker_size(self, marker_id):
        """Side of a marker [m]."""
        corners = self.corners[marker_id]
        return math.dist(corners[1], corners[0])


def _square_pose(corners):
    """Pose of the square with corners (4, 3)."""
    x = corners[1] - corners[0]
    x /= np.linalg.norm(x)
    y = corners[0] - corners[3]
    y /= np.linalg.norm(y)
    return Pose(np.column_stack([x, y, np.cross(x, y)]), corners.mean(axis=0))


def single_marker(name, marker_id, size):
    """A Target of one marker.

    Raises:
        TargetError: a size [m] that no marker has, or a negative id.
    """
    _check_size(f"{name}: marker size", size)
    _check_id(name, marker_id)
    return Target(name, {int(marker_id): size * UNIT_CORNERS})


def parse_solid(text, default_size):
    """A Target from `name:id` or `name:id:size`; TargetError when it is neither."""
    parts = [part.strip() for part in str(text).split(":")]
    form = f"solid marker {text!r}: expected name:id or name:id:size in metres"
    if len(parts) not in (2, 3) or not parts[0]:
        raise TargetError(form)
    _check_name(parts[0])
    try:
        marker_id = int(parts[1])
        size = float(parts[2]) if len(parts) == 3 else default_size
    except ValueError:
        raise TargetError(form) from None
    return single_marker(parts[0], marker_id, size)


def check_targets(targets):
    """TargetError when two targets share a name or an id."""
    names, owners = set(), {}
    for target in targets:
        if target.name in names:
            raise TargetError(f"{target.name}: named twice, expected names of their own")
        names.add(target.name)
        for marker_id in target.ids:
            if marker_id in owners:
                raise TargetError(
                    f"marker id {marker_id} belongs to {owners[marker_id]} and to {target.name}"
                )
            owners[marker_id] = target.name


# ---------------------------------------------------------------- boards


def load_boards(path):
    """Name -> Target of a boards file.

    Raises:
        TargetError: it cannot be read, or something in it is wrong.
    """
    path = Path(path)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise TargetError(
            f"{path}: cannot be read ({getattr(error, 'strerror', error)})"
        ) from error
    except yaml.YAMLError as error:
        raise TargetError(f"{path}: is not YAML ({' '.join(str(error).split())})") from error
    boards = content.get("boards") if isinstance(content, dict) else None
    if not isinstance(boards, dict) or not boards or len(content) != 1:
        raise TargetError(f"{path}: expected the one key boards with names below it")
    try:
        return {str(name): _board(str(name), board) for name, board in boards.items()}
    except TargetError as error:
        raise TargetError(f"{path}: {error}") from None


def _board(name, board):
    _check_name(name)
    if not isinstance(board, dict) or len(board) != 1 or next(iter(board)) not in _KINDS:
        raise TargetError(f"{name}: expected one of the keys {', '.join(_KINDS)}, got {board!r}")
    kind, settings = next(iter(board.items()))
    try:
        corners = _KINDS[kind](**settings) if isinstance(settings, dict) else _KINDS[kind](settings)
    except TypeError as error:
        text = str(error).replace("_corners()", "").lstrip("_")
        raise TargetError(f"{name}: {text}") from None
    except TargetError as error:
        raise TargetError(f"{name}: {error}") from None
    return Target(name, corners)


def _markers_corners(markers):
    if not isinstance(markers, list) or not markers:
        raise TargetError(f"markers: expected a list, got {markers!r}")
    corners = {}
    for marker in markers:
        if not isinstance(marker, dict):
            raise TargetError(f"markers: expected {{id, size, position}}, got {marker!r}")
        marker_id, placed = _placed_marker(**marker)
        if marker_id in corners:
            raise TargetError(f"marker id {marker_id} is there twice")
        corners[marker_id] = placed
    return corners


def _placed_marker(id, size, position=(0.0, 0.0, 0.0), quat_xyzw=(0.0, 0.0, 0.0, 1.0)):  # noqa: A002
    _check_id("marker", id)
    _check_size(f"marker {id}: size", size)
    for key, value, count in (("position", position, 3), ("quat_xyzw", quat_xyzw, 4)):
        if np.shape(value) != (count,) or not np.isfinite(np.asarray(value, float)).all():
            raise TargetError(f"marker {id}: {key}: expected {count} numbers, got {value!r}")
    if not np.linalg.norm(quat_xyzw) > 1e-6:
        raise TargetError(f"marker {id}: quat_xyzw: expected a rotation, got zeros")
    return id, pose_from_quaternion(position, quat_xyzw).apply(size * UNIT_CORNERS)


def grid_corners(columns, rows, size, gap, first_id=0):
    """Corners of a grid of markers, ids row by row from the top; origin in the middle of the grid.

    Args:
        columns, rows: number of markers.
        size: side of a marker [m].
        gap: between two markers [m].
        first_id: of the marker at the top left.
    """
    _check_count("columns", columns)
    _check_count("rows", rows)
    _check_size("size", size)
    _check_size("gap", gap, zero=True)
    _check_id("first_id", first_id)
    pitch = size + gap
    corners = {}
    for row in range(rows):
        for column in range(columns):
            centre = pitch * np.array([column - 0.5 * (columns - 1), 0.5 * (rows - 1) - row, 0])
            corners[first_id + row * columns + column] = size * UNIT_CORNERS + centre
    return corners


def charuco_corners(columns, rows, square, size, first_id=0):
    """Corners of the markers of a ChArUco board, as OpenCV 4.7 and later draw it.

    Its top left square is black; markers lie in the white squares. Origin in the board's middle.

    Args:
        columns, rows: number of squares.
        square: side of a square [m].
        size: side of a marker [m], below `square`.
        first_id: of the first marker.
    """
    _check_count("columns", columns)
    _check_count("rows", rows)
    _check_size("size", size)
    _check_size("square", square)
    _check_id("first_id", first_id)
    if size >= square:
        raise TargetError(f"size: expected below the square's {square:g} m, got {size:g}")
    corners = {}
    for row in range(rows):
        for column in range(columns):
            if (row + column) % 2 == 1:
                centre = np.array([column - 0.5 * (columns - 1), 0.5 * (rows - 1) - row, 0])
                corners[first_id + len(corners)] = size * UNIT_CORNERS + square * centre
    return corners


def cube_corners(edge, size, ids):
    """Corners of the markers on a cube, see CUBE_FACES; origin in the cube's middle.

    Args:
        edge: of the cube [m].
        size: side of a marker [m], at most `edge`.
        ids: five (no bottom) or six.
    """
    _check_size("edge", edge)
    _check_size("size", size)
    if not isinstance(ids, list | tuple) or not 1 <= len(ids) <= 6 or len(set(ids)) != len(ids):
        raise TargetError(f"ids: expected one to six different numbers, got {ids!r}")
    if size > edge:
        raise TargetError(f"size: expected at most the edge's {edge:g} m, got {size:g}")
    corners = {}
    for marker_id, face in zip(ids, CUBE_FACES, strict=False):
        _check_id("ids", marker_id)
        corners[marker_id] = Pose(face, 0.5 * edge * face[:, 2]).apply(size * UNIT_CORNERS)
    return corners


_KINDS = {
    "markers": _markers_corners,
    "grid": grid_corners,
    "charuco": charuco_corners,
    "cube": cube_corners,
}


# ---------------------------------------------------------------- checks


def _check_size(what, size, zero=False):
    good = isinstance(size, int | float) and not isinstance(size, bool) and math.isfinite(size)
    if not good or size < 0.0 or (size == 0.0 and not zero):
        raise TargetError(f"{what}: expected metres above 0, got {size!r}")


def _check_count(what, count):
    if not isinstance(count, int) or not 1 <= count <= 100:
        raise TargetError(f"{what}: expected 1 to 100, got {count!r}")


def _check_id(what, marker_id):
    if not isinstance(marker_id, int) or isinstance(marker_id, bool) or marker_id < 0:
        raise TargetError(f"{what}: expected a marker id of 0 or more, got {marker_id!r}")


def _check_name(name):
    if not name.isidentifier() or not name.isascii():
        raise TargetError(f"name {name!r}: expected letters, digits and _ as in a ROS topic")
