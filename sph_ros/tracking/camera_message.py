# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/CameraInfo in CDR bytes as a camera model."""

from msg_adapters.cdr import CdrReader
from msg_adapters.header import read_header
from sph_ros.tracking.camera import camera_from_fields

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

#: Bytes of the encapsulation header and the stamp: what comes after changes only with the camera.
STAMP_END = 12


class UncalibratedError(ValueError):
    """The message says that the camera was never calibrated: K is zeros (as CameraInfo defines)."""


def cdr_to_camera(buffer, rectified=False):
    """The CameraModel of a sensor_msgs/CameraInfo.

    Args:
        buffer: CDR bytes.
        rectified: the pictures are rectified, so that P holds and not K and D.

    Raises:
        CameraError: values that no camera has.
        UncalibratedError: K is zeros.
        ValueError: the bytes are not a CameraInfo.
    """
    reader = CdrReader(buffer, CAMERA_INFO)
    read_header(reader)
    height, width = reader.unpack("2I")
    model = reader.string()
    distortion = reader.array(float, reader.count())
    matrix, _rectification = reader.unpack("9d"), reader.unpack("9d")
    projection = reader.unpack("12d")
    binning = reader.unpack("2I")
    left, top, roi_height, roi_width = reader.unpack("4I")
    reader.unpack("B")
    reader.end()
    if not any(matrix):
        raise UncalibratedError("camera_info says that the camera is not calibrated: K is zeros")
    return camera_from_fields(
        width,
        height,
        model,
        distortion,
        matrix,
        projection,
        rectified,
        binning,
        (left, top, roi_width, roi_height),
    )
