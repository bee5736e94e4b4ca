# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/CameraInfo in CDR bytes as a camera model, and back."""

import numpy as np

from msg_adapters.cdr import CdrReader, CdrWriter
from msg_adapters.header import read_header, write_header
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


def camera_to_cdr(camera, stamp_ns, frame_id):
    """A CameraModel as a ready sensor_msgs/CameraInfo of unrectified pictures.

    Args:
        camera: CameraModel.
        stamp_ns: time [ns].
        frame_id: optical frame of the camera.
    """
    distortion = camera.distortion if len(camera.distortion) else np.zeros(5)
    writer = CdrWriter()
    write_header(writer, stamp_ns, frame_id)
    writer.pack("2I", camera.height, camera.width)
    writer.string("rational_polynomial" if len(distortion) > 5 else "plumb_bob")
    writer.array(distortion, count=len(distortion))
    writer.pack("9d", *camera.matrix.ravel())
    writer.pack("9d", *np.eye(3).ravel())
    writer.pack("12d", *np.hstack([camera.matrix, np.zeros((3, 1))]).ravel())
    writer.pack("2I", 0, 0)  # binning
    writer.pack("4I", 0, 0, 0, 0)  # region of interest: all
    writer.pack("?", False)
    return writer.finish()
