# SPDX-License-Identifier: Apache-2.0
"""Which calibration holds now: a file's, the newest camera_info's, or a stated guess."""

import time
from typing import NamedTuple

from sph_ros.tracking.camera import (
    GUESSED_FIELD_OF_VIEW,
    CameraError,
    CameraModel,
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


class _Known(NamedTuple):
    """What is known: a camera, or why there is none; nothing at first."""

    camera: CameraModel | None = None
    error: CameraError | None = None
    uncalibrated: bool = False


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
        self._known = _Known()
        self._body = None
        self._first_picture = None
        self._next_reading = 0.0

    def hear(self, buffer):
        """Take a camera_info message in CDR bytes; a file has precedence."""
        body = bytes(buffer[STAMP_END:])
        if self._url or body == self._body:
            return
        self._body = body
        try:
            self._known = _Known(camera=cdr_to_camera(buffer, self._rectified))
        except UncalibratedError:
            self._known = _Known(uncalibrated=True)
        except ValueError as error:
            self._known = _Known(error=CameraError(f"camera_info cannot be used: {error}"))

    def for_picture(self, width, height):
        """The CameraModel for a picture of this size.

        Raises:
            CameraError: the calibration is wrong, or for another size.
            WaitingError: there is none yet.
        """
        if self._url:
            self._read_file()
        known = self._known  # a bag's thread may set another one meanwhile
        if known.error is not None:
            raise known.error
        if known.camera is None:
            return self._guess(width, height)
        known.camera.check_size(width, height)
        return known.camera

    def note(self, camera):
        """What people should know about a camera; "" when nothing."""
        if not camera.approximate:
            return ""
        reason = (
            "camera_info has K of zeros" if self._known.uncalibrated else "there is no calibration"
        )
        return (
            f"{reason}: a field of view of {GUESSED_FIELD_OF_VIEW:g} degrees is assumed, so the "
            "scale is approximate; `sph_ros calibrate` makes one"
        )

    def _guess(self, width, height):
        now = time.monotonic()
        self._first_picture = now if self._first_picture is None else self._first_picture
        waiting = self._expect_messages and not self._known.uncalibrated
        if waiting and now - self._first_picture < PATIENCE:
            raise WaitingError("waiting for camera_info")
        return guessed_camera(width, height)

    def _read_file(self):
        now = time.monotonic()
        if self._known.camera is not None or now < self._next_reading:
            return
        self._next_reading = now + RETRY_TIME
        try:
            self._known = _Known(camera=load_camera(self._url, self._rectified))
        except CameraError as error:
            self._known = _Known(error=error)
