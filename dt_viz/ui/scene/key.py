"""Keys of exported pictures: the names of lines with their colours, on an almost opaque plate."""

from __future__ import annotations

from dataclasses import dataclass

from PIL import Image, ImageDraw, ImageFont

from dt_viz.ui.scene.palette import Colour

INK: Colour = (52, 58, 68)
"""Colour of the text in exported pictures."""
Font = ImageFont.FreeTypeFont | ImageFont.ImageFont


@dataclass(frozen=True)
class Key:
    """Names of lines in a picture, each with its colour."""

    lines: tuple[tuple[str, Colour], ...]

    def drawn(self, em: int) -> Image.Image:
        """Draw the key as an RGBA image in type of a size in pixels."""
        line, left, stroke = round(1.45 * em), round(0.8 * em), round(1.6 * em)
        widest = max(ImageFont.load_default(em).getlength(name) for name, _ in self.lines)
        card, draw, font = plate(round(widest) + 3 * left + stroke, (len(self.lines) + 1) * line, em)
        for k, (name, colour) in enumerate(self.lines, start=1):
            draw.line((left, k * line, left + stroke, k * line), colour, max(em // 4, 2))
            draw.text((2 * left + stroke, k * line), name, INK, font, anchor="lm")
        return card


def plate(width: int, height: int, em: int) -> tuple[Image.Image, ImageDraw.ImageDraw, Font]:
    """Return an almost opaque plate of a size in pixels, what draws on it, and a font."""
    card = Image.new("RGBA", (width, height))
    draw = ImageDraw.Draw(card)
    draw.rounded_rectangle((0, 0, width - 1, height - 1), radius=em // 2, fill=(255, 255, 255, 225))
    return card, draw, ImageFont.load_default(em)
