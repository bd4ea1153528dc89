"""Legends: names of what is drawn, and scales of colours, as HTML and for exported pictures."""

from __future__ import annotations

import html
from collections.abc import Iterable
from dataclasses import dataclass

from PIL import Image, ImageDraw, ImageFont

from dt_viz.ui.scene.colour_scale import NUM_SHADES, Scale
from dt_viz.ui.scene.palette import Colour, css

INK: Colour = (52, 58, 68)  # colour of the text in exported pictures


@dataclass(frozen=True)
class Legend:
    """Names of colours, below a scale of them from left to right if there is one.

    Texts are ASCII: Pillow's own font has hardly more.
    """

    names: tuple[tuple[str, Colour | None], ...]  # names or notes, each with its colour, if it has one
    title: str = ""  # quantity of the scale, with its unit
    scale: Scale | None = None
    ticks: tuple[tuple[float, str], ...] = ()  # values of the scale and their labels

    @property
    def html(self) -> str:
        """HTML for the panel."""
        look = "display:inline-block;width:1.6em;height:0.4em;vertical-align:0.15em;margin-right:0.6em;background:"
        marks = [f"<span style='{look}{css(colour)}'></span>" if colour else "" for _, colour in self.names]
        names = "".join(
            f"<div>{mark}{html.escape(name)}</div>" for mark, (name, _) in zip(marks, self.names, strict=True)
        )
        if self.scale is None:
            return names
        stops = ",".join(f"rgb({r},{g},{b})" for r, g, b in self.scale.shades[:: NUM_SHADES // 16].tolist())
        numbers = "".join(
            f"<span style='position:absolute;left:{at:.1f}%;transform:translateX(-{at:.1f}%)'>"
            f"{html.escape(text)}</span>"
            for at, text in ((100 * self.scale.relative(value), text) for value, text in self.ticks)
        )
        return (
            f"<div style='font-size:0.8em;padding:0.2em 1.6em 0.5em;line-height:1.4'>{html.escape(self.title)}"
            f"<div style='height:0.8em;border-radius:2px;background:linear-gradient(to right,{stops})'></div>"
            f"<div style='position:relative;height:1.5em'>{numbers}</div>{names}</div>"
        )

    def drawn(self, em: int) -> Image.Image:
        """Draw it on an almost opaque plate, as an RGBA image in type of a size in pixels."""
        font, line, left = ImageFont.load_default(em), round(1.45 * em), round(1.4 * em)
        indents = [round(2.2 * em) if colour else 0 for _, colour in self.names]
        widths = [font.getlength(name) + indent for indent, (name, _) in zip(indents, self.names, strict=True)]
        above, width = (0, round(max(widths))) if self.scale is None else (3 * line, 24 * em)
        card = Image.new("RGBA", (width + 2 * left, above + (len(self.names) + 1) * line))
        draw = ImageDraw.Draw(card)
        draw.rounded_rectangle((0, 0, card.width - 1, card.height - 1), radius=em // 2, fill=(255, 255, 255, 225))
        if self.scale is not None:
            draw.text((left, line), self.title, INK, font, anchor="lm")
            shades = Image.fromarray(self.scale.shades[None])
            card.paste(shades.resize((width, round(0.8 * em)), Image.Resampling.BILINEAR), (left, round(1.55 * line)))
            for value, text in self.ticks:
                at = left + self.scale.relative(value) * width
                draw.text((at, round(2.9 * line)), text, INK, font, anchor="mm")
        for k, (indent, (name, colour)) in enumerate(zip(indents, self.names, strict=True), start=1):
            middle = above + k * line
            if colour:
                draw.line((left, middle, left + round(1.6 * em), middle), colour, max(round(0.4 * em), 2))
            draw.text((left + indent, middle), name, INK, font, anchor="lm")
        return card


def explained(image: Image.Image, legends: Iterable[Legend], *, transparent: bool) -> Image.Image:
    """Return an RGBA image with legends, scaled to its height, one above the other in its lower left corner.

    It is on white, as RGB, unless it is to be transparent.
    """
    whole, em = image.copy(), round(0.022 * image.height)
    if not transparent:
        whole = Image.alpha_composite(Image.new("RGBA", image.size, "white"), whole)
    bottom = image.height - em
    for legend in legends:
        card = legend.drawn(em)
        whole.alpha_composite(card, (em, bottom - card.height))
        bottom -= card.height + em // 2
    return whole if transparent else whole.convert("RGB")
