# SPDX-License-Identifier: Apache-2.0
"""Pixels of any ROS encoding as a grey or a BGR picture."""

import cv2
import numpy as np

# encoding -> (conversion to grey, conversion to BGR); None: as it is. ROS names a Bayer pattern by
# its first two rows, OpenCV by the second and third pixel of its second row.
_CONVERSIONS = {
    "mono8": (None, cv2.COLOR_GRAY2BGR),
    "8UC1": (None, cv2.COLOR_GRAY2BGR),
    "bgr8": (cv2.COLOR_BGR2GRAY, None),
    "8UC3": (cv2.COLOR_BGR2GRAY, None),
    "rgb8": (cv2.COLOR_RGB2GRAY, cv2.COLOR_RGB2BGR),
    "bgra8": (cv2.COLOR_BGRA2GRAY, cv2.COLOR_BGRA2BGR),
    "rgba8": (cv2.COLOR_RGBA2GRAY, cv2.COLOR_RGBA2BGR),
    "yuv422": (cv2.COLOR_YUV2GRAY_UYVY, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (cv2.COLOR_YUV2GRAY_UYVY, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (cv2.COLOR_YUV2GRAY_YUY2, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": (cv2.COLOR_YUV2GRAY_YUY2, cv2.COLOR_YUV2BGR_YUY2),
    "bayer_rggb8": (cv2.COLOR_BayerBG2GRAY, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": (cv2.COLOR_BayerRG2GRAY, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": (cv2.COLOR_BayerGR2GRAY, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": (cv2.COLOR_BayerGB2GRAY, cv2.COLOR_BayerGB2BGR),
}
ENCODINGS = (*_CONVERSIONS, "mono16", "16UC1")


class ImageError(ValueError):
    """A picture cannot be used; says what it is and what was expected."""


def to_gray(pixels, encoding):
    """A grey picture (H, W) uint8.

    Args:
        pixels: (H, W) or (H, W, channels), uint8 (uint16 for mono16), not empty.
        encoding: one of ENCODINGS.

    Raises:
        ImageError: another encoding, or an empty picture.
    """
    return _converted(pixels, encoding, 0)


def to_bgr(pixels, encoding):
    """A picture (H, W, 3) uint8; arguments and errors as in `to_gray`."""
    return _converted(pixels, encoding, 1)


def decode(data, image_format="", color=True):
    """The picture in a compressed file's bytes: (H, W, 3) uint8 BGR, or (H, W) uint8 grey.

    Args:
        data: the bytes.
        image_format: for the error's text.
        color: whether colours are wanted; grey is faster.

    Raises:
        ImageError: it is no picture that OpenCV can read.
    """
    buffer = np.frombuffer(data, np.uint8)
    mode = cv2.IMREAD_COLOR if color else cv2.IMREAD_GRAYSCALE
    picture = cv2.imdecode(buffer, mode) if len(buffer) else None
    if picture is None:
        raise ImageError(
            f"compressed picture of {len(buffer)} bytes, format {image_format!r}: cannot be "
            "decoded, expected a complete jpeg or png"
        )
    return picture


def _converted(pixels, encoding, column):
    if pixels.size == 0:
        raise ImageError(f"the picture is empty: {pixels.shape[1]} x {pixels.shape[0]} pixels")
    if encoding in ("mono16", "16UC1"):
        # Sensors of 10 or 12 bits leave the upper bits empty: stretch to what is there.
        top = max(int(pixels.max()), 1)
        pixels, encoding = (pixels * (255.0 / top)).astype(np.uint8), "mono8"
    if encoding not in _CONVERSIONS:
        raise ImageError(f"encoding is {encoding!r}, expected one of {', '.join(ENCODINGS)}")
    conversion = _CONVERSIONS[encoding][column]
    pixels = np.ascontiguousarray(pixels)
    return pixels if conversion is None else cv2.cvtColor(pixels, conversion)
