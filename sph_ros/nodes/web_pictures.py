# SPDX-License-Identifier: Apache-2.0
"""A camera's picture in a small window beside the liquid. No rclpy."""

import cv2
import numpy as np

from msg_adapters.image import (
    COMPRESSED_IMAGE,
    IMAGE,
    cdr_to_compressed_image,
    cdr_to_image,
)

#: Larger pictures are made smaller for the page [pixels].
LARGEST_WIDTH = 640

#: Place and width of the window on the page [pixels]; negative: from the far edge.
PLACE = {"x": 15.0, "y": -15.0, "width": 340.0}

_TO_RGB = {
    "bgr8": cv2.COLOR_BGR2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB,
    "8UC1": cv2.COLOR_GRAY2RGB,
    "8UC3": cv2.COLOR_BGR2RGB,
}


def decode_picture(data, type_name):
    """Pixels of a picture for the page, (H, W, 3) uint8 RGB.

    Args:
        data: CDR bytes.
        type_name: IMAGE or COMPRESSED_IMAGE.

    Raises:
        ValueError: it is no picture, or of a kind that has no colours.
    """
    if type_name == COMPRESSED_IMAGE:
        pixels = cv2.imdecode(
            np.frombuffer(cdr_to_compressed_image(data).data, np.uint8), cv2.IMREAD_COLOR
        )
        if pixels is None:
            raise ValueError("a compressed picture that OpenCV cannot read")
        code = cv2.COLOR_BGR2RGB
    elif type_name == IMAGE:
        image = cdr_to_image(data)
        pixels, code = np.ascontiguousarray(image.pixels), _TO_RGB.get(image.encoding)
        if code is None and image.encoding != "rgb8":
            raise ValueError(
                f"a picture of encoding {image.encoding}, expected rgb8 or one of "
                f"{', '.join(_TO_RGB)}"
            )
    else:
        raise ValueError(f"messages of {type_name}, expected {IMAGE} or {COMPRESSED_IMAGE}")
    height, width = pixels.shape[:2]
    if width > LARGEST_WIDTH:  # first, so that the rest is cheap
        size = (LARGEST_WIDTH, max(1, round(height * LARGEST_WIDTH / width)))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return pixels if code is None else cv2.cvtColor(pixels, code)


class PictureWindow:
    """The window; it appears with the first picture.

    Args:
        server: a ViserServer.
        title: of the window.
    """

    def __init__(self, server, title):
        self._server, self._title = server, title
        self._panel = self._image = None

    def show(self, pixels):
        """Show a picture, (H, W, 3) uint8 RGB."""
        if self._panel is None:
            self._panel = self._server.gui.add_panel()
            with self._panel.add_tab(self._title, "camera"):
                self._image = self._server.gui.add_image(pixels, format="jpeg", jpeg_quality=80)
            self._panel.float(**PLACE)
        else:
            self._image.image = pixels

    def close(self):
        """There are no pictures any more."""
        if self._panel is not None:
            self._panel.remove()
            self._panel = self._image = None
