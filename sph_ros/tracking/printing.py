# SPDX-License-Identifier: Apache-2.0
"""A PDF of markers at true size: the two defaults, a cube wand's net, a calibration board."""

from typing import NamedTuple

import numpy as np

from sph_ros.tracking.detection import get_dictionary, marker_picture
from sph_ros.tracking.targets import charuco_corners

#: Paper sizes (width, height) [mm].
PAPERS = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}

DICTIONARY = "DICT_4X4_50"
WORLD_ID, SOLID_ID = 0, 1
MARKER_SIZE = 80.0  # [mm], the tracker's default

CUBE_IDS = (2, 3, 4, 5, 6, 7)  # top, front, right, back, left, bottom
#: [mm]. The margin is wide: OpenCV 4.6 takes the cube's own outline for the marker if it is near.
CUBE_EDGE, CUBE_MARKER = 45.0, 30.0


class CharucoBoard(NamedTuple):
    """A chessboard with markers in its white squares; lengths in metres."""

    columns: int = 5
    rows: int = 7
    square: float = 0.035
    size: float = 0.026
    first_id: int = 10


CHARUCO = CharucoBoard()

_MM_PER_INCH = 25.4


def print_markers(path, paper="a4"):
    """Write the PDF.

    Args:
        path: of the file to write.
        paper: one of PAPERS.

    Raises:
        ValueError: another paper.
        OSError: the file cannot be written.
    """
    if paper not in PAPERS:
        raise ValueError(f"paper is {paper!r}, expected one of {', '.join(PAPERS)}")
    import matplotlib

    matplotlib.use("pdf")
    from matplotlib.backends.backend_pdf import PdfPages

    with PdfPages(path) as pdf:
        for draw in (_marker_page, _cube_page, _charuco_page):
            figure, axes = _page(paper)
            draw(axes, *PAPERS[paper])
            pdf.savefig(figure)


def _page(paper):
    """A figure of the size of the paper, and axes on it in millimetres from its lower left."""
    from matplotlib.figure import Figure

    width, height = PAPERS[paper]
    figure = Figure(figsize=(width / _MM_PER_INCH, height / _MM_PER_INCH))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(0, width)
    axes.set_ylim(0, height)
    axes.axis("off")
    return figure, axes


def _marker_page(axes, width, height):
    left = 0.5 * (width - MARKER_SIZE)
    places = (
        (WORLD_ID, "world marker: lies still, its frame is the liquid's", height - 30.0),
        (SOLID_ID, "solid marker: in the hand, moves the solid `ball`", height - 150.0),
    )
    for marker_id, text, top in places:
        _cut_frame(axes, left - 16.0, top - MARKER_SIZE - 16.0, MARKER_SIZE + 32.0)
        _draw_marker(axes, marker_id, left, top - MARKER_SIZE, MARKER_SIZE)
        label = f"{DICTIONARY} id {marker_id}, {MARKER_SIZE:g} mm, {text}"
        axes.text(0.5 * width, top + 8.0, label, ha="center", fontsize=7.5)
    _ruler(axes, 0.5 * width - 75.0, 14.0)


def _cube_page(axes, width, height):
    """Four faces in a row, top and bottom at the second, with flaps to glue."""
    edge = CUBE_EDGE
    left, row = 0.5 * width - 2.0 * edge, 0.5 * height
    top, front, right, back, side, bottom = CUBE_IDS
    faces = {side: (0, 0), front: (1, 0), right: (2, 0), back: (3, 0), top: (1, 1), bottom: (1, -1)}
    corners = {i: (left + x * edge, row + y * edge) for i, (x, y) in faces.items()}
    for x, y in corners.values():
        axes.plot([x, x + edge, x + edge, x, x], [y, y, y + edge, y + edge, y], "0.6", lw=0.5)
    for (x, y), sides in ((corners[top], "lrt"), (corners[bottom], "lrb"), (corners[back], "r")):
        for where in sides:
            _flap(axes, x, y, edge, where)
    for marker_id, (x, y) in corners.items():
        margin = 0.5 * (edge - CUBE_MARKER)
        _draw_marker(axes, marker_id, x + margin, y + margin, CUBE_MARKER)
    text = (
        f"Cube wand, edge {edge:g} mm: cut out, fold along the lines, glue. Boards file:\n"
        f"boards: {{wand: {{cube: {{edge: {edge / 1000:g}, size: {CUBE_MARKER / 1000:g}, "
        f"ids: {list(CUBE_IDS)}}}}}}}"
    )
    axes.text(0.5 * width, height - 30.0, text, ha="center", va="top", fontsize=9)
    _ruler(axes, 0.5 * width - 75.0, 14.0)


def _charuco_page(axes, width, height):
    board = CHARUCO
    square = 1000.0 * board.square
    left, low = 0.5 * (width - board.columns * square), 0.5 * (height - board.rows * square) + 4.0
    for row in range(board.rows):
        for column in range(board.columns):
            if (row + column) % 2 == 0:
                top = low + (board.rows - row) * square
                _black(axes, left + column * square, top - square, square, square)
    centre = np.array([left + 0.5 * board.columns * square, low + 0.5 * board.rows * square])
    for marker_id, corners in charuco_corners(*board).items():
        x, y = centre + 1000.0 * corners[3, :2]
        _draw_marker(axes, marker_id, x, y, 1000.0 * board.size)
    text = (
        f"Calibration board for `sph_ros calibrate`: {board.columns} x {board.rows} squares of "
        f"{square:g} mm, markers {1000 * board.size:g} mm. Keep it flat."
    )
    axes.text(0.5 * width, 6.0, text, ha="center", fontsize=8)


# ---------------------------------------------------------------- parts of a page


def _draw_marker(axes, marker_id, x, y, size):
    """A marker whose lower left corner is at (x, y) [mm]: black, with white modules on it."""
    dictionary = get_dictionary(DICTIONARY)
    modules = dictionary.markerSize + 2
    picture = marker_picture(dictionary, marker_id, modules)
    module = size / modules
    _black(axes, x, y, size, size)
    for row, column in np.argwhere(picture > 127):
        place = x + column * module, y + size - (row + 1) * module
        _rectangle(axes, *place, module, module, "white")


def _black(axes, x, y, width, height):
    _rectangle(axes, x, y, width, height, "black")


def _rectangle(axes, x, y, width, height, color):
    from matplotlib.patches import Rectangle

    patch = Rectangle((x, y), width, height, facecolor=color, edgecolor="none", linewidth=0)
    axes.add_patch(patch)


def _cut_frame(axes, x, y, size):
    xs, ys = [x, x + size, x + size, x, x], [y, y, y + size, y + size, y]
    axes.plot(xs, ys, "0.7", lw=0.4, ls=(0, (4, 4)))


def _flap(axes, x, y, edge, where):
    """A trapezoid of 6 mm at the left, right, top or bottom side of a face."""
    depth, slant = 6.0, 4.0
    along = np.array([0.0, slant, edge - slant, edge])
    out = np.array([0.0, depth, depth, 0.0])
    xs, ys = {
        "t": (x + along, y + edge + out),
        "b": (x + along, y - out),
        "l": (x - out, y + along),
        "r": (x + edge + out, y + along),
    }[where]
    axes.plot(xs, ys, "0.7", lw=0.4)


def _ruler(axes, x, y):
    """150 mm with millimetres, to check that the printer did not scale."""
    axes.plot([x, x + 150.0], [y, y], "k", lw=0.6)
    for millimetre in range(151):
        length = 5.0 if millimetre % 10 == 0 else 3.5 if millimetre % 5 == 0 else 2.0
        axes.plot([x + millimetre] * 2, [y, y + length], "k", lw=0.25)
        if millimetre % 10 == 0:
            axes.text(x + millimetre, y + 6.0, str(millimetre), ha="center", fontsize=6)
    text = "millimetres: check with a real ruler; print at 100 %, not `fit to page`"
    axes.text(x + 75.0, y - 5.0, text, ha="center", fontsize=7)
