# SPDX-License-Identifier: Apache-2.0
"""Pictures that the tracker opens itself: a camera, a video file, a folder of pictures, a bag.

A source runs in a thread of its own and hands over pictures at the times at which they were taken.
"""

import threading
import time
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from msg_adapters.bags import BagError, open_bag
from msg_adapters.header import NANOSECONDS
from msg_adapters.image import (
    COMPRESSED_IMAGE,
    IMAGE,
    cdr_to_compressed_image,
    cdr_to_image,
)
from sph_ros.tracking.camera_message import CAMERA_INFO
from sph_ros.tracking.images import decode

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff")

#: A camera that cannot be opened, or went away, is tried again so often [s].
RETRY_TIME = 1.0

FOLDER_RATE = 30.0  # [Hz]


class SourceError(ValueError):
    """A source cannot be used; says which, and what was expected."""


class Picture(NamedTuple):
    """A decoded picture and when it was taken; stamp 0: now."""

    pixels: np.ndarray  # (H, W, 3) uint8 BGR
    stamp_ns: int


class Encoded(NamedTuple):
    """A message of a bag: Image, CompressedImage or CameraInfo in CDR bytes."""

    type: str
    data: bytes


def decoded(thing, color=True):
    """(pixels, encoding, stamp_ns, frame_id) of a Picture, or of an Image or CompressedImage.

    Args:
        thing: Picture or Encoded.
        color: whether colours are wanted; without, what is compressed becomes grey.

    Raises:
        ValueError: the bytes are not such a message, or cannot be decoded.
    """
    if isinstance(thing, Picture):
        return thing.pixels, "bgr8", thing.stamp_ns, "camera"
    if thing.type == COMPRESSED_IMAGE:
        message = cdr_to_compressed_image(thing.data)
        pixels = decode(message.data, message.format, color)
        encoding = "bgr8" if color else "mono8"
    else:
        message = cdr_to_image(thing.data)
        pixels, encoding = message.pixels, message.encoding
    return pixels, encoding, message.header.stamp_ns, message.header.frame_id or "camera"


class Source:
    """Runs pictures through `put` until it is stopped.

    Args:
        put: called with a Picture or an Encoded.
        name: for people.

    Attributes:
        problem: why no pictures come, "" while they do.
        brings_camera: whether a calibration comes with the pictures.
    """

    brings_camera = False

    def __init__(self, put, name):
        self.name = name
        self.problem = ""
        self._put = put
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="image_source", daemon=True)

    def start(self):
        """Begin."""
        self._thread.start()

    def stop(self):
        """End, and wait for the end."""
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)

    def _run(self):
        try:
            self._deliver()
        except Exception as error:  # whatever a damaged file makes of its library
            self.problem = f"{self.name}: {' '.join(str(error).split())}"

    def _wait_until(self, moment):
        """Sleep until a time of the monotonic clock [s]; whether to go on."""
        return not self._stopped.wait(max(0.0, moment - time.monotonic()))


class DeviceSource(Source):
    """A camera, opened again whenever it comes back.

    Args:
        put: see Source.
        device: number or path.
    """

    def __init__(self, put, device):
        super().__init__(put, f"camera {device}")
        self._device = device

    def _deliver(self):
        while not self._stopped.is_set():
            capture = cv2.VideoCapture(self._device)
            try:
                if capture.isOpened():
                    self._read(capture)
                else:
                    self.problem = (
                        f"{self.name} cannot be opened (no such device, in use, or no permission), "
                        f"trying again every {RETRY_TIME:g} s"
                    )
            finally:
                capture.release()
            self._stopped.wait(RETRY_TIME)

    def _read(self, capture):
        while not self._stopped.is_set():
            good, pixels = capture.read()
            if not good:
                self.problem = (
                    f"{self.name} gives no more pictures (unplugged?), "
                    f"trying again every {RETRY_TIME:g} s"
                )
                return
            self.problem = ""
            self._put(Picture(pixels, 0))


class VideoSource(Source):
    """A video file at its own rate, once or for ever."""

    def __init__(self, put, path, rate=0.0, loop=False):
        super().__init__(put, str(path))
        self._path, self._rate, self._loop = path, rate, loop
        capture = cv2.VideoCapture(str(path))
        opened = capture.isOpened()
        capture.release()
        if not opened:
            raise SourceError(f"{path}: OpenCV cannot open it, expected a video file")

    def _deliver(self):
        while True:
            capture = cv2.VideoCapture(str(self._path))
            rate = self._rate or capture.get(cv2.CAP_PROP_FPS)
            period = 1.0 / rate if 0.1 < rate < 1000.0 else 1.0 / FOLDER_RATE
            begin, count = time.monotonic(), 0
            good, pixels = capture.read()
            while good and self._wait_until(begin + count * period):
                self._put(Picture(pixels, 0))
                count += 1
                good, pixels = capture.read()
            capture.release()
            if self._stopped.is_set() or not self._loop or count == 0:
                self.problem = f"{self.name}: at its end"
                return
            self._wait_until(begin + count * period)


class FolderSource(Source):
    """Pictures of a folder in the order of their names."""

    def __init__(self, put, path, rate=0.0, loop=False):
        super().__init__(put, str(path))
        self._files = sorted(p for p in Path(path).iterdir() if p.suffix.lower() in PICTURES)
        self._period, self._loop = 1.0 / (rate or FOLDER_RATE), loop
        if not self._files:
            raise SourceError(f"{path}: no pictures in it, expected {', '.join(PICTURES)}")

    def _deliver(self):
        begin, count = time.monotonic(), 0
        while True:
            for file in self._files:
                pixels = cv2.imread(str(file), cv2.IMREAD_COLOR)
                if not self._wait_until(begin + count * self._period):
                    return
                count += 1
                self.problem = "" if pixels is not None else f"{file}: not a picture"
                if pixels is not None:
                    self._put(Picture(pixels, 0))
            if not self._loop:
                self.problem = f"{self.name}: at its end"
                return


class BagSource(Source):
    """Pictures and calibration of a recording, in its own rhythm and with its own stamps."""

    def __init__(self, put, path, topic="", loop=False):
        super().__init__(put, str(path))
        self._path, self._loop = path, loop
        try:
            with open_bag(path) as bag:
                self._topics = self._choose(bag, topic)
        except BagError as error:
            raise SourceError(str(error)) from None

    def _choose(self, bag, topic):
        if topic:
            chosen = bag.require(topic)
            if chosen.type not in (IMAGE, COMPRESSED_IMAGE):
                raise SourceError(f"{self.name}: {topic} has {chosen.type}, expected pictures")
        else:
            pictures = [t for t in bag.topics.values() if t.count and "Image" in t.type]
            pictures = [t for t in pictures if t.type in (IMAGE, COMPRESSED_IMAGE)]
            if len(pictures) != 1:
                names = ", ".join(t.name for t in pictures) or "none"
                raise SourceError(
                    f"{self.name}: expected one topic of pictures, or source_topic to name it; "
                    f"there are: {names}"
                )
            chosen = pictures[0]
        cameras = [t.name for t in bag.topics.values() if t.type == CAMERA_INFO and t.count]
        # camera_info lies beside the pictures; of several only that one is theirs.
        parent = chosen.name.rsplit("/", 2 if chosen.type == COMPRESSED_IMAGE else 1)[0]
        beside = [name for name in cameras if name.rsplit("/", 1)[0] == parent]
        self.brings_camera = bool(cameras)
        return [chosen.name, *(beside or cameras)[:1]]

    def _deliver(self):
        while True:
            with open_bag(self._path) as bag:
                begin, first = time.monotonic(), None
                for message in bag.messages(self._topics):
                    first = message.stamp_ns if first is None else first
                    if not self._wait_until(begin + (message.stamp_ns - first) / NANOSECONDS):
                        return
                    self._put(Encoded(message.type, message.data))
            if not self._loop:
                self.problem = f"{self.name}: at its end"
                return


def make_source(text, put, rate=0.0, topic="", loop=False):
    """The Source that a text means.

    Args:
        text: number or /dev path of a camera, video file, folder of pictures, bag.
        put: see Source.
        rate: pictures per second of videos and folders [Hz]; 0 for their own.
        topic: of a bag's pictures; "" for the only one.
        loop: start over at the end.

    Raises:
        SourceError: it means nothing that exists.
    """
    if text.isdecimal():
        return DeviceSource(put, int(text))
    if text.startswith("/dev/"):
        return DeviceSource(put, text)
    path = Path(text)
    if not path.exists():
        raise SourceError(
            f"source {text!r}: expected the number of a camera, or an existing video file, folder "
            "of pictures or bag"
        )
    if path.suffix in (".mcap", ".db3") or (path / "metadata.yaml").is_file():
        return BagSource(put, path, topic, loop)
    if path.is_dir():
        return FolderSource(put, path, rate, loop)
    if path.suffix.lower() in PICTURES:
        raise SourceError(f"source {text!r}: a single picture, expected its folder")
    return VideoSource(put, path, rate, loop)
