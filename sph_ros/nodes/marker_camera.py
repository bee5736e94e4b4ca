# SPDX-License-Identifier: Apache-2.0
"""Which calibration holds now: a file's, the newest camera_info's, or a stated guess."""

import time

from sph_ros.tracking.camera import (
    GUESSED_FIELD_OF_VIEW,
    CameraError,
    guessed_camera,
    load_camera,
)
from sph_ros.tracking.camera_message import STAMP_END, UncalibratedError, cdr_to_camera

#: Pictures wait so long for a first camera_info before a calibration is guessed [s].
PATIENCE = 1.0

#: A calibration file that cannot be used is read again so often [s].
RETRY_TIME = 2.0


class WaitingError(ValueError):
    """There is no calibration yet, but one may come at any moment."""


class CalibrationChoice:
    """Finds the camera model for a picture.

    Args:
        url: of a calibration file; "" for camera_info messages.
        rectified: the pictures are rectified.
        expect_messages: whether camera_info messages may come at all.
    """

    def __init__(self, url, rectified, expect_messages):
        self._url = url
        self._rectified = rectified
        self._expect_messages = expect_messages
        self._camera = None
        self._error = None
        self._body = None
        self._first_picture = None
        self._next_reading = 0.0
        self._uncalibrated = False

    def hear(self, buffer):
        """Take a camera_info message in CDR bytes; a file has precedence."""
        body = bytes(buffer[STAMP_END:])
        if self._url or body == self._body:
            return
        self._body = body
        self._camera = self._error = None
        self._uncalibrated = False
        try:
            self._camera = cdr_to_camera(buffer, self._rectified)
        except UncalibratedError:
            self._uncalibrated = True
        except ValueError as error:
            self._error = CameraError(f"camera_info cannot be used: {error}")

    def for_picture(self, width, height):
        """The CameraModel for a picture of this size.

        Raises:
            CameraError: the calibration is wrong, or for another size.
            WaitingError: there is none yet.
        """
        if self._url:
            self._read_file()
        if self._error is not None:
            raise self._error
        if self._camera is None:
            return self._guess(width, height)
        self._camera.check_size(width, height)
        return self._camera

    def note(self, camera):
        """What people should know about a camera; "" when nothing."""
        if not camera.approximate:
            return ""
        reason = "camera_info has K of zeros" if self._uncalibrated else "there is no calibration"
        return (
            f"{reason}: a field of view of {GUESSED_FIELD_OF_VIEW:g} degrees is assumed, so the "
            "scale is approximate; `sph_ros calibrate` makes one"
        )

    def _guess(self, width, height):
        now = time.monotonic()
        self._first_picture = now if self._first_picture is None else self._first_picture
        waiting = self._expect_messages and not self._uncalibrated
        if waiting and now - self._first_picture < PATIENCE:
            raise WaitingError("waiting for camera_info")
        return guessed_camera(width, height)

    def _read_file(self):
        now = time.monotonic()
        if self._camera is not None or now < self._next_reading:
            return
        self._next_reading = now + RETRY_TIME
        self._error = None
        try:
            self._camera = load_camera(self._url, self._rectified)
        except CameraError as error:
            self._error = error
