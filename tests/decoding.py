"""Videos as a player sees them: decoded by ffmpeg."""

import re
import subprocess

import numpy as np
from imageio_ffmpeg import get_ffmpeg_exe


def decoded(file):
    """What ffmpeg tells of a video, and its frames (N, height, width, 3), RGB."""
    command = get_ffmpeg_exe(), "-i", str(file), "-fps_mode", "passthrough", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"
    result = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=True)
    told = result.stderr.decode()
    width, height = (int(side) for side in re.findall(r"Video: .*?, (\d+)x(\d+)", told)[0])
    return told, np.frombuffer(result.stdout, np.uint8).reshape(-1, height, width, 3)
