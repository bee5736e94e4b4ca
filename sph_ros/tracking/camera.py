# SPDX-License-Identifier: Apache-2.0
"""Camera models: pinhole with OpenCV's distortion, from ROS or OpenCV calibration files."""

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

from sph_ros.core.pinhole import projected

#: Field of view across the picture that is assumed without a calibration [degrees].
GUESSED_FIELD_OF_VIEW = 60.0

# Numbers of coefficients, in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6.
_COEFFICIENTS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (0, 4, 5, 8, 12, 14)}


class CameraError(ValueError):
    """A calibration cannot be used; says which value is wrong and what was expected."""


@dataclass(frozen=True, eq=False)
class CameraModel:
    """What turns points in the camera's optical frame (x right, y down, z forward) into pixels.

    Attributes:
        width, height: of the picture [pixels]; 0 when the calibration does not say.
        matrix: K, (3, 3) [pixels].
        distortion: OpenCV's k1 k2 p1 p2 k3 ..., (n,).
        approximate: whether it is a guess, so that distances are approximate.
        lens: the same for kernels: K, twelve coefficients, projection of a tilted sensor (3, 3).
    """

    width: int
    height: int
    matrix: np.ndarray
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(0))
    approximate: bool = False
    lens: tuple = field(init=False, repr=False)

    def __post_init__(self):
        matrix = np.array(self.matrix, float)
        distortion = np.array(self.distortion, float).ravel()
        _check_matrix(matrix)
        if not np.isfinite(distortion).all():
            raise CameraError(f"distortion coefficients {distortion.tolist()} are not finite")
        if len(distortion) not in (0, 4, 5, 8, 12, 14):
            raise CameraError(
                f"{len(distortion)} distortion coefficients, expected 0, 4, 5, 8, 12 or 14"
            )
        matrix.flags.writeable = distortion.flags.writeable = False
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "distortion", distortion)
        object.__setattr__(self, "lens", (matrix, *_lens(distortion)))

    def check_size(self, width, height):
        """CameraError unless this calibration is for pictures of this size [pixels]."""
        if (self.width, self.height) not in ((0, 0), (width, height)):
            raise CameraError(
                f"the picture has {width} x {height} pixels, but its calibration is for "
                f"{self.width} x {self.height}"
            )

    def project(self, points):
        """Pixels (N, 2) of points (N, 3) [m] in the camera's frame, which lie in front of it."""
        return projected(np.ascontiguousarray(points, float).reshape(-1, 3), *self.lens)


def _check_matrix(matrix):
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise CameraError(f"camera matrix {matrix.tolist()}, expected 3 x 3 finite numbers")
    if not (matrix[0, 0] > 0.0 and matrix[1, 1] > 0.0):
        raise CameraError(
            f"focal lengths are {matrix[0, 0]:g} and {matrix[1, 1]:g}, expected above 0 "
            "(a camera matrix of zeros means that the camera is not calibrated)"
        )
    if not np.allclose(matrix[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        raise CameraError(f"camera matrix {matrix.tolist()}, expected the last row 0 0 1")


def _lens(distortion):
    """Twelve coefficients, and the projection (3, 3) of a sensor tilted by the other two."""
    padded = np.zeros(14)
    padded[: len(distortion)] = distortion
    (sine_x, sine_y), (cosine_x, cosine_y) = np.sin(padded[12:]), np.cos(padded[12:])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cosine_x, sine_x], [0.0, -sine_x, cosine_x]])
    about_y = np.array([[cosine_y, 0.0, -sine_y], [0.0, 1.0, 0.0], [sine_y, 0.0, cosine_y]])
    turn = about_y @ about_x
    onto = np.eye(3)
    onto[0, 0] = onto[1, 1] = turn[2, 2]
    onto[:2, 2] = -turn[:2, 2]
    coefficients, tilt = padded[:12].copy(), onto @ turn
    coefficients.flags.writeable = tilt.flags.writeable = False
    return coefficients, tilt


def guessed_camera(width, height):
    """A stated guess for an unknown webcam: no distortion, GUESSED_FIELD_OF_VIEW across."""
    if not (width > 0 and height > 0):
        raise CameraError(f"the picture has {width} x {height} pixels, expected some")
    focal = 0.5 * width / math.tan(math.radians(0.5 * GUESSED_FIELD_OF_VIEW))
    matrix = [[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]]
    return CameraModel(width, height, np.array(matrix), approximate=True)


def camera_from_fields(
    width, height, model, distortion, matrix, projection, rectified=False, binning=(1, 1), roi=None
):
    """A camera from the fields of sensor_msgs/CameraInfo.

    Args:
        width, height: of the full sensor [pixels].
        model: ``plumb_bob`` or ``rational_polynomial``.
        distortion: D, (n,).
        matrix: K, 9 numbers.
        projection: P, 12 numbers; its left 3 x 3 block describes rectified pictures.
        rectified: the pictures are rectified.
        binning: pixels summed up to one in x and y; 0 means 1.
        roi: (x, y, width, height) of the part read out [full pixels]; zeros or None mean all.

    Raises:
        CameraError: a model that is not known, or values that no camera has.
    """
    if rectified:
        chosen, coefficients = np.reshape(np.asarray(projection, float), (3, 4))[:, :3], ()
    else:
        _check_model(model, distortion)
        chosen, coefficients = np.reshape(np.asarray(matrix, float), (3, 3)), distortion
    chosen = np.array(chosen)
    _check_matrix(chosen)
    if roi is not None and roi[2] > 0 and roi[3] > 0:
        chosen[:2, 2] -= roi[:2]
        width, height = roi[2:]
    step = np.maximum(binning, 1)
    # Pixel centres are at whole numbers, so binning moves the origin by half a pixel.
    chosen[:2, 2] = (chosen[:2, 2] + 0.5) / step - 0.5
    chosen[0, :2] /= step[0]
    chosen[1, 1] /= step[1]
    return CameraModel(
        int(width) // int(step[0]), int(height) // int(step[1]), chosen, coefficients
    )


def _check_model(model, distortion):
    if model not in _COEFFICIENTS and (model or len(distortion)):
        raise CameraError(
            f"distortion model is {model!r}, expected one of {', '.join(_COEFFICIENTS)}; "
            "pictures of other models can be used rectified"
        )
    if model and len(distortion) not in _COEFFICIENTS[model]:
        raise CameraError(
            f"{model} with {len(distortion)} distortion coefficients, expected one of "
            f"{_COEFFICIENTS[model]}"
        )


# ---------------------------------------------------------------- files


class _Loader(yaml.SafeLoader):
    """YAML with OpenCV's matrices."""


_Loader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, True)
)


def load_camera(path, rectified=False):
    """A camera from a ROS camera_info YAML file or one that OpenCV's FileStorage wrote.

    Args:
        path: of the file; ``file://`` in front is allowed.
        rectified: the pictures are rectified.

    Raises:
        CameraError: it cannot be read, or is no calibration.
    """
    path = Path(str(path).removeprefix("file://"))
    try:
        text = path.read_text(encoding="utf-8")
        # OpenCV writes a first line that YAML does not allow.
        content = yaml.load(text.removeprefix("%YAML:1.0"), _Loader)
    except (OSError, UnicodeDecodeError) as error:
        raise CameraError(
            f"{path}: cannot be read ({getattr(error, 'strerror', error)})"
        ) from error
    except yaml.YAMLError as error:
        raise CameraError(f"{path}: is not YAML ({' '.join(str(error).split())})") from error
    try:
        return _camera_from_content(content, rectified)
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from None


def _camera_from_content(content, rectified):
    if not isinstance(content, dict) or "camera_matrix" not in content:
        raise CameraError("expected a calibration with the key camera_matrix")
    coefficients = content.get("distortion_coefficients", content.get("dist_coeffs"))
    distortion = _numbers("distortion_coefficients", coefficients, None)
    model = content.get("distortion_model")
    if model is None:  # OpenCV's files do not name it
        model = "rational_polynomial" if len(distortion) > 5 else "plumb_bob"
    projection = np.zeros(12)
    if rectified:
        projection = _numbers("projection_matrix", content.get("projection_matrix"), 12)
    width, height = (_size(content, key) for key in ("image_width", "image_height"))
    matrix = _numbers("camera_matrix", content["camera_matrix"], 9)
    return camera_from_fields(width, height, str(model), distortion, matrix, projection, rectified)


def _size(content, key):
    value = content.get(key, 0)
    if not isinstance(value, int) or value < 0:
        raise CameraError(f"{key}: expected a number of pixels, got {value!r}")
    return value


def _numbers(key, value, count):
    data = value.get("data") if isinstance(value, dict) else value
    try:
        numbers = np.asarray([] if data is None else data, float).ravel()
    except (TypeError, ValueError):
        raise CameraError(f"{key}: expected numbers, got {data!r}") from None
    if count is not None and len(numbers) != count:
        raise CameraError(f"{key}: expected {count} numbers, got {len(numbers)}")
    return numbers


def camera_yaml(camera, name="camera"):
    """The text of a ROS camera_info YAML file; rectification is none, the camera is single."""
    distortion = camera.distortion if len(camera.distortion) else np.zeros(5)
    model = "rational_polynomial" if len(distortion) > 5 else "plumb_bob"
    matrices = {
        "camera_matrix": camera.matrix,
        "distortion_coefficients": distortion[None],
        "rectification_matrix": np.eye(3),
        "projection_matrix": np.hstack([camera.matrix, np.zeros((3, 1))]),
    }
    lines = [f"image_width: {camera.width}", f"image_height: {camera.height}"]
    lines.append(f"camera_name: {name}")
    for key, matrix in matrices.items():
        if key == "distortion_coefficients":
            lines.append(f"distortion_model: {model}")
        data = ", ".join(f"{value:.9g}" for value in matrix.ravel())
        lines.append(f"{key}:\n  rows: {matrix.shape[0]}\n  cols: {matrix.shape[1]}")
        lines.append(f"  data: [{data}]")
    return "\n".join(lines) + "\n"
