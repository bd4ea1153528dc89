"""Videos: frames that ffmpeg, a process of its own, encodes as they come."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from dt_viz.errors import FormatError
from dt_viz.folders import TemporaryFolder

_HD = ("-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709")
_ENCODING: Mapping[str, tuple[str, ...]] = {
    ".mp4": (
        *("-vf", "scale=out_color_matrix=bt709:out_range=tv,format=yuv420p", *_HD),
        *("-c:v", "libx264", "-preset", "veryfast", "-crf", "18", "-movflags", "+faststart"),
    ),
    # each frame has a palette of its own: one for all would need all frames at once
    ".gif": ("-filter_complex", "split[a][b];[a]palettegen=stats_mode=single[p];[b][p]paletteuse=new=1", "-loop", "0"),
}
"""Arguments of ffmpeg by the suffix of the file; slide programs play MP4 in yuv420p that begins with its index."""
VIDEO_SUFFIXES = tuple(_ENCODING)  # suffixes of the files
NICENESS = 10  # niceness of ffmpeg: what follows a hand comes first


def ffmpeg() -> str:
    """Return the path of ffmpeg. Raises FormatError if there is none."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe  # noqa: PLC0415 - an extra

        return get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        raise FormatError("ffmpeg", "not installed", "pip install 'dt-viz[video]'") from None


class Encoder:
    """A video that is being encoded; its process and its file are gone at the end of a `with` block."""

    def __init__(self, suffix: str, size: tuple[int, int], rate: int) -> None:
        """Begin a video.

        Args:
            suffix: one of `VIDEO_SUFFIXES`.
            size: even width and height, pixels.
            rate: frames a second.

        Raises:
            FormatError: ffmpeg is not installed.
        """
        frames = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", str(rate), "-i", "-")
        threads = ("-threads", "1", "-filter_threads", "1", "-filter_complex_threads", "1")
        command = ffmpeg(), "-loglevel", "error", *threads, *frames, *threads[:2], *_ENCODING[suffix]
        self._folder = TemporaryFolder()
        self._file, self._said = (Path(self._folder.name) / name for name in (f"video{suffix}", "said.txt"))
        with self._said.open("wb") as said:
            self._process = subprocess.Popen(
                (*command, str(self._file)), stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=said
            )
        assert self._process.stdin is not None
        self._input = self._process.stdin
        if hasattr(os, "setpriority"):
            with suppress(OSError):  # it has ended already
                os.setpriority(os.PRIO_PROCESS, self._process.pid, NICENESS)

    def __enter__(self) -> Encoder:
        return self

    def __exit__(self, *_error: object) -> None:
        self._process.kill()
        self._process.wait()
        with suppress(OSError):  # what it has not read
            self._input.close()
        self._folder.cleanup()

    def write(self, frame: bytes) -> None:
        """Add the pixels of a frame, RGB, row by row; wait while ffmpeg encodes those before.

        Raises:
            FormatError: ffmpeg fails.
        """
        try:
            self._input.write(frame)
            self._input.flush()
        except OSError:
            raise self._failure() from None

    def finish(self) -> bytes:
        """End the video; return the content of its file. Raises FormatError if ffmpeg fails."""
        with suppress(OSError):  # it has failed, and said why
            self._input.close()
        if self._process.wait():
            raise self._failure()
        return self._file.read_bytes()

    def _failure(self) -> FormatError:
        lines = self._said.read_text(errors="replace").split("\n")
        said = next(filter(None, reversed(lines)), "no reason given")
        return FormatError("ffmpeg", f"a failure ({said})", "frames that it encodes")
