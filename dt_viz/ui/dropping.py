"""Several files at once for an upload button of viser, which sends one."""

from __future__ import annotations

import viser


def drop_html(_button: viser.GuiUploadButtonHandle) -> str:
    """Return nothing yet."""
    return ""
