# SPDX-License-Identifier: Apache-2.0
"""Videos: H.264 in MP4, playable everywhere, written frame by frame."""

import os
from pathlib import Path

import numpy as np


class VideoWriter:
    """Context manager that takes RGB pictures and leaves a video.

        with VideoWriter("water.mp4", (1280, 720), fps=30) as video:
            video.add(picture)

    The file appears under its name only when everything went well; until then, and after an error,
    there is nothing half-written there. Odd sizes lose a row or column: yuv420p has only even ones.
    """

    def __init__(self, path, size, fps=30.0, quality=8):
        """Check what can be checked; nothing is written yet.

        Args:
            path: of the video, ending in .mp4.
            size: (width, height) in pixels.
            fps: pictures per second.
            quality: 0 smallest to 10 best.

        Raises:
            ValueError: another ending, size under two pixels, fps not positive.
        """
        self.path = Path(path)
        self.size = tuple(int(n) for n in size)
        self.frame_count = 0
        self._fps, self._quality = float(fps), quality
        self._sink = self._temporary = None
        if self.path.suffix.lower() != ".mp4":
            raise ValueError(f"{path}: expected a name ending in .mp4")
        if min(self.size) < 2:
            raise ValueError(f"video: size {size}, expected at least 2 x 2 pixels")
        if not (np.isfinite(self._fps) and self._fps > 0.0):
            raise ValueError(f"video: fps {fps}, expected a positive number")

    def __enter__(self):
        """Start ffmpeg.

        Raises:
            RuntimeError: there is no ffmpeg.
            OSError: the folder does not exist.
        """
        if not self.path.parent.is_dir():
            raise FileNotFoundError(f"{self.path}: there is no folder {self.path.parent}")
        self._temporary = self.path.with_name(f".{self.path.stem}.{os.getpid()}.mp4")
        self._sink = _ffmpeg(self._temporary, self._even_size(), self._fps, self._quality)
        return self

    def add(self, picture) -> None:
        """Append one picture (height, width, 3) uint8 RGB.

        Raises:
            ValueError: another shape or type.
        """
        width, height = self.size
        if np.shape(picture) != (height, width, 3) or np.asarray(picture).dtype != np.uint8:
            raise ValueError(
                f"picture: {np.shape(picture)} {np.asarray(picture).dtype}, "
                f"expected {(height, width, 3)} uint8"
            )
        width, height = self._even_size()
        self._sink.send(np.ascontiguousarray(picture[:height, :width]))
        self.frame_count += 1

    def __exit__(self, kind, error, trace):
        """Finish the file and give it its name; on an error, or without pictures, leave none."""
        self._sink.close()
        if kind is None and self.frame_count:
            os.replace(self._temporary, self.path)
        else:
            self._temporary.unlink(missing_ok=True)

    def _even_size(self):
        return self.size[0] // 2 * 2, self.size[1] // 2 * 2


def _ffmpeg(path, size, fps, quality):
    """A started generator of imageio-ffmpeg that takes pictures."""
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise RuntimeError(
            "a video needs ffmpeg: pip install imageio-ffmpeg, or install ffmpeg "
            f"and set IMAGEIO_FFMPEG_EXE ({error})"
        ) from error
    sink = imageio_ffmpeg.write_frames(
        str(path),
        size,
        fps=fps,
        codec="libx264",
        pix_fmt_in="rgb24",
        pix_fmt_out="yuv420p",
        quality=quality,
        macro_block_size=2,
        output_params=["-movflags", "+faststart"],
    )
    sink.send(None)
    return sink
