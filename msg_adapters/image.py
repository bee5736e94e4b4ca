# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/Image and CompressedImage, in and out. Compressed pictures stay compressed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from msg_adapters.cdr import CdrReader, CdrWriter
from msg_adapters.header import Header, read_header, write_header

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"

# Encoding names of sensor_msgs/image_encodings.hpp that pictures and depth cameras use. YUV 4:2:2
# has two bytes a pixel, the colour of a Bayer pixel depends on its place.
_ENCODINGS = {
    "mono8": ("u1", 1),
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
    "rgba8": ("u1", 4),
    "bgra8": ("u1", 4),
    "mono16": ("u2", 1),
    "rgb16": ("u2", 3),
    "bgr16": ("u2", 3),
    "8UC1": ("u1", 1),
    "8UC3": ("u1", 3),
    "16UC1": ("u2", 1),
    "32FC1": ("f4", 1),
    "yuv422": ("u1", 2),
    "yuv422_yuy2": ("u1", 2),
    "uyvy": ("u1", 2),
    "yuyv": ("u1", 2),
    "bayer_rggb8": ("u1", 1),
    "bayer_bggr8": ("u1", 1),
    "bayer_gbrg8": ("u1", 1),
    "bayer_grbg8": ("u1", 1),
}


class Image(NamedTuple):
    """A picture at a time in a camera's frame."""

    header: Header
    encoding: str
    pixels: np.ndarray  # (H, W), or (H, W, channels) for more than one channel


class CompressedImage(NamedTuple):
    """A picture as a file, such as PNG or JPEG."""

    header: Header
    format: str
    data: memoryview


def image_to_cdr(pixels: np.ndarray, encoding: str, stamp_ns: int, frame_id: str) -> bytes:
    """A picture as a ready sensor_msgs/Image.

    Args:
        pixels: (H, W) or (H, W, channels) of the encoding's type, rows from the top.
        encoding: Such as ``rgb8``, ``mono8``, ``16UC1``.
        stamp_ns: Time [ns].
        frame_id: Optical frame of the camera.

    Raises:
        ValueError: An unknown encoding, or pixels that do not have it.
    """
    code, channels = _encoding(encoding)
    expected = (*pixels.shape[:2], channels) if channels > 1 else pixels.shape[:2]
    if len(expected) < 2 or pixels.shape != expected or pixels.dtype != np.dtype(code):
        raise ValueError(
            f"pixels has shape {pixels.shape} of {pixels.dtype}, expected (H, W"
            f"{f', {channels}' if channels > 1 else ''}) of {np.dtype(code).name} for {encoding}"
        )
    height, width = pixels.shape[:2]
    writer = CdrWriter()
    write_header(writer, stamp_ns, frame_id)
    writer.pack("2I", height, width)
    writer.string(encoding)
    writer.pack("?", False)  # is_bigendian
    writer.pack("I", width * channels * pixels.dtype.itemsize)
    writer.blob(np.ascontiguousarray(pixels).reshape(-1).view(np.uint8))
    return writer.finish()


def cdr_to_image(buffer: bytes) -> Image:
    """A sensor_msgs/Image from its bytes; pixels are a read-only view, in native byte order.

    Raises:
        ValueError: The bytes are not an image, its encoding is unknown, or its sizes contradict.
    """
    reader = CdrReader(buffer, IMAGE)
    header = read_header(reader)
    height, width = reader.unpack("2I")
    encoding = reader.string()
    (is_bigendian,) = reader.unpack("B")
    (step,) = reader.unpack("I")
    data = reader.blob()
    reader.end()
    code, channels = _encoding(encoding)
    dtype = np.dtype(code).newbyteorder(">" if is_bigendian else "<")
    pixel_size = dtype.itemsize * channels
    if step < width * pixel_size or len(data) != height * step:
        raise reader.fail(
            f"{len(data)} bytes of data in rows of {step}, expected {height} rows of at least "
            f"{width * pixel_size}"
        )
    shape = (height, width, channels) if channels > 1 else (height, width)
    strides = (step, pixel_size, dtype.itemsize)[: len(shape)]
    pixels = np.ndarray(shape, dtype, buffer=data, strides=strides)
    return Image(header, encoding, pixels.astype(dtype.newbyteorder("="), copy=False))


def compressed_image_to_cdr(data: bytes, image_format: str, stamp_ns: int, frame_id: str) -> bytes:
    """An image file's content as a ready sensor_msgs/CompressedImage.

    Args:
        data: The file, such as what ``cv2.imencode`` returns.
        image_format: Such as ``png`` or ``jpeg``.
        stamp_ns: Time [ns].
        frame_id: Optical frame of the camera.
    """
    writer = CdrWriter()
    write_header(writer, stamp_ns, frame_id)
    writer.string(image_format)
    writer.blob(data)
    return writer.finish()


def cdr_to_compressed_image(buffer: bytes) -> CompressedImage:
    """A sensor_msgs/CompressedImage from its bytes; ValueError when they are not one."""
    reader = CdrReader(buffer, COMPRESSED_IMAGE)
    image = CompressedImage(read_header(reader), reader.string(), reader.blob())
    reader.end()
    return image


def _encoding(name: str) -> tuple[str, int]:
    """(dtype code, channels); ValueError when unknown."""
    if name not in _ENCODINGS:
        raise ValueError(f"encoding is {name!r}, expected one of {', '.join(_ENCODINGS)}")
    return _ENCODINGS[name]
