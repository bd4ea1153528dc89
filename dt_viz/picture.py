"""A picture of a scene without a page: PNG, MP4 or GIF by an installed Chromium, SVG, PDF, or an HTML page that plays.

dt-viz picture fig-4 --out fig4.png --size 3840x2160
dt-viz picture draw_s --out s.svg
dt-viz picture fig-4 --out fig4.html
dt-viz picture tour-2 --out warp.png
dt-viz picture lift --out lift.mp4 --of turntable
dt-viz picture mine.json --out mine.png
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from dt_viz.arguments import Parser

OF = ("motion", "turntable", "warp")  # what a video shows


def main(arguments: Sequence[str], prog: str) -> int:
    """Make a picture; returns the process' exit status, or raises SystemExit where argparse does."""
    parser = Parser(prog=prog, description=(__doc__ or "").splitlines()[0])
    what = "a scene, such as fig-4 or its name, a task, tour-1 to 6, or the .json of a saved scenario"
    parser.add_argument("scene", metavar="SCENE", help=what)
    out = "a .png, .svg, .pdf, .html, .mp4 or .gif"
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=out)
    parser.add_argument("--size", metavar="WxH", help="pixels of a PNG (default: 1920x1080) or a video (1280x720)")
    parser.add_argument("--of", choices=OF, default=OF[0], help="what a video shows (default: %(default)s)")
    options = parser.parse_args(arguments)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from dt_viz.picture_making import make  # noqa: PLC0415 - numerical libraries read these when they are imported

    return make(options, prog)
