"""What the site has beside its pages: the project's pictures, and scenes that play in them, made when it is built."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

from dt_viz.picture import main as picture

ASSETS = Path(__file__).parents[1] / "assets"
REPLAYS = ("lift",)
"""Names of the scenes that are embedded."""


def on_files(files: Files, *, config: Any) -> Files:  # noqa: ANN401 - of mkdocs
    """Add the pictures under `assets/`, and a page that plays each of the scenes under `replays/`."""
    for path in sorted(ASSETS.rglob("*.png")):
        files.append(File.generated(config, f"assets/{path.relative_to(ASSETS)}", abs_src_path=str(path)))
    with tempfile.TemporaryDirectory() as folder:
        for name in REPLAYS:
            page = Path(folder) / f"{name}.html"
            if picture([name, "--out", str(page)], prog="dt-viz picture"):
                raise RuntimeError(f"no page that plays {name}")
            files.append(File.generated(config, f"replays/{name}.html", content=page.read_bytes()))
    return files
