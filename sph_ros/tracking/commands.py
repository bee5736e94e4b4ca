# SPDX-License-Identifier: Apache-2.0
"""`sph_ros markers` and `sph_ros calibrate`.

What they need is imported when they run, so that `--help` answers at once.
"""

import argparse
from pathlib import Path


class CommandError(ValueError):
    """A file or camera cannot be used; one line that says why."""


_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".tif", ".tiff")


def add_markers(commands):
    """Add the subcommand `markers` to argparse's subparsers."""
    parser = commands.add_parser(
        "markers",
        help="a PDF of the printed markers at true size",
        description="Three pages: the two default markers with a ruler, the net of a cube wand, "
        "and a board for `sph_ros calibrate`. Print at 100 %.",
    )
    parser.add_argument("--out", metavar="FILE", default="markers.pdf", help="default: markers.pdf")
    parser.add_argument("--paper", choices=("a4", "letter"), default="a4", help="default: a4")
    parser.set_defaults(run=run_markers)


def add_calibrate(commands):
    """Add the subcommand `calibrate` to argparse's subparsers."""
    parser = commands.add_parser(
        "calibrate",
        help="a camera's calibration from pictures of the printed board",
        description="Move the board of `sph_ros markers` before the camera, near and far, tilted, "
        "into every corner of the picture. Writes a ROS camera_info YAML file.",
    )
    add = parser.add_argument
    add("source", metavar="SOURCE", help="number of a camera, video file, or folder of pictures")
    add("--out", metavar="FILE", default="camera.yaml", help="default: camera.yaml")
    add("--name", default="camera", help="of the camera, written into the file")
    add("--pictures", type=int, default=25, metavar="N", help="useful ones to collect (25)")
    add("--square", type=_metres, metavar="M", help="side of a square of the board [m]")
    add("--size", type=_metres, metavar="M", help="side of a marker on it [m]")
    add("--columns", type=int, help="number of its squares across")
    add("--rows", type=int, help="number of its squares down")
    add("--first-id", type=int, help="of its markers; defaults: as printed")
    add("--dictionary", default="DICT_4X4_50", help="of its markers")
    parser.set_defaults(run=run_calibrate)


def run_markers(options):
    """Write the PDF; returns the exit status."""
    from sph_ros.tracking.printing import print_markers

    try:
        print_markers(options.out, options.paper)
    except OSError as error:
        raise CommandError(f"{options.out}: cannot be written ({error.strerror})") from error
    print(f"{options.out}: print at 100 %, then check the ruler")
    return 0


def run_calibrate(options):
    """Calibrate and write the YAML file; returns the exit status."""
    import cv2

    from sph_ros.tracking.calibration import Calibrator
    from sph_ros.tracking.camera import camera_yaml
    from sph_ros.tracking.printing import CHARUCO

    given = {key: getattr(options, key) for key in CHARUCO._fields}
    board = CHARUCO._replace(**{key: value for key, value in given.items() if value is not None})
    calibrator = Calibrator(board, options.dictionary)
    try:
        for picture in _pictures(options.source):
            if calibrator.look(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)):
                print(f"\r{len(calibrator.views)} of {options.pictures} ", end="", flush=True)
            if len(calibrator.views) >= options.pictures:
                break
    except KeyboardInterrupt:  # enough, says the user
        pass
    print()
    result = calibrator.calibrate()
    try:
        Path(options.out).write_text(camera_yaml(result.camera, options.name), encoding="utf-8")
    except OSError as error:
        raise CommandError(f"{options.out}: cannot be written ({error.strerror})") from error
    print(f"{options.out}: {result.views} pictures, residual {result.residual:.3f} pixels")
    return 0


def _pictures(source):
    """All pictures (H, W, 3) uint8 BGR of a camera, video or folder."""
    import cv2

    if Path(source).is_dir():
        files = sorted(p for p in Path(source).iterdir() if p.suffix.lower() in _PICTURES)
        if not files:
            raise CommandError(f"{source}: no pictures in it")
        for file in files:
            picture = cv2.imread(str(file), cv2.IMREAD_COLOR)
            if picture is not None:
                yield picture
        return
    capture = cv2.VideoCapture(int(source) if source.isdecimal() else source)
    if not capture.isOpened():
        raise CommandError(f"{source}: no camera, video or folder that can be opened")
    try:
        good, picture = capture.read()
        while good:
            yield picture
            good, picture = capture.read()
    finally:
        capture.release()


def _metres(text):
    value = float(text)
    if not 0.0 < value < 10.0:
        raise argparse.ArgumentTypeError(f"expected metres above 0, got {text!r}")
    return value
