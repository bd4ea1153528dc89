"""Legends of the colours on the slice, for the panel and for exported pictures."""

from __future__ import annotations

import html
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from PIL import Image

from dt_viz.pictures.slice_fields import ColourPicture
from dt_viz.scenario.scenario import SliceColour
from dt_viz.session.frame import Frame
from dt_viz.ui.scene.colour_scale import NUM_SHADES, Scale
from dt_viz.ui.scene.palette import LIGHT, Colour, css
from dt_viz.ui.scene.picture import INK, Key, plate
from dt_viz.ui.scene.slice_layers import DET_DECADES, OCCUPANCY_SCALE, scale_of


@dataclass(frozen=True)
class Legend:
    """A scale of colours with numbers, from left to right. Texts are ASCII: Pillow's own font has hardly more."""

    title: str  # quantity with its unit
    scale: Scale
    ticks: tuple[tuple[float, str], ...]  # values and their labels
    note: str = ""  # text below the scale
    swatch: Colour | None = None  # colour that the note explains

    @property
    def html(self) -> str:
        """HTML for the panel."""
        stops = ",".join(f"rgb({r},{g},{b})" for r, g, b in self.scale.shades[:: NUM_SHADES // 16].tolist())
        numbers = "".join(
            f"<span style='position:absolute;left:{at:.1f}%;transform:translateX(-{at:.1f}%)'>"
            f"{html.escape(text)}</span>"
            for at, text in ((100 * self.scale.relative(value), text) for value, text in self.ticks)
        )
        mark = ""
        if self.swatch:
            look = f"display:inline-block;width:1.2em;height:0.7em;background:{css(self.swatch)}"
            mark = f"<span style='{look}'></span> "
        return (
            f"<div style='font-size:0.8em;padding:0.2em 1.6em 0.5em;line-height:1.4'>{html.escape(self.title)}"
            f"<div style='height:0.8em;border-radius:2px;background:linear-gradient(to right,{stops})'></div>"
            f"<div style='position:relative;height:1.5em'>{numbers}</div>{mark}{html.escape(self.note)}</div>"
        )

    def drawn(self, em: int) -> Image.Image:
        """Draw the legend as an RGBA image in type of a size in pixels."""
        line, left, width = round(1.45 * em), round(1.6 * em), 24 * em
        card, draw, font = plate(width + 2 * left, (4 + bool(self.note)) * line, em)
        draw.text((left, line), self.title, INK, font, anchor="lm")
        shades = Image.fromarray(self.scale.shades[None]).resize((width, round(0.8 * em)), Image.Resampling.BILINEAR)
        card.paste(shades, (left, round(1.55 * line)))
        for value, text in self.ticks:
            draw.text((left + self.scale.relative(value) * width, round(2.9 * line)), text, INK, font, anchor="mm")
        if self.note:
            start = left
            if self.swatch:
                low = 3.95 * line
                draw.rectangle((left, low - 0.35 * em, left + 1.2 * em, low + 0.35 * em), fill=self.swatch)
                start += round(1.7 * em)
            draw.text((start, round(3.95 * line)), self.note, INK, font, anchor="lm")
        return card


def drawn_onto(image: Image.Image, legends: Iterable[Legend | Key]) -> Image.Image:
    """Draw legends onto a copy of an RGBA image, one above the other in its lower left corner, scaled to its height."""
    whole, em = image.copy(), round(0.022 * image.height)
    bottom = image.height - em
    for legend in legends:
        card = legend.drawn(em)
        whole.alpha_composite(card, (em, bottom - card.height))
        bottom -= card.height + em // 2
    return whole


OCCUPANCY = Legend(
    "Learned occupancy: how likely something is there",
    OCCUPANCY_SCALE,
    tuple((p, f"{p:g}") for p in (0, 0.25, 0.5, 0.75, 1)),
    "Bold line: its level 0.5. Thin line: the true outline",
)


def legend_in(frame: Frame, colour: SliceColour) -> Legend | None:
    """Return the legend of a colour on the slice of a frame; None if the frame has no picture of it."""
    picture = frame.pictures.colour
    if colour == "occupancy":
        return OCCUPANCY
    return legend_of(picture) if picture is not None and picture.what == colour else None


def legend_of(picture: ColourPicture) -> Legend:
    """Return the legend of a picture."""
    scale = scale_of(picture)
    if picture.what == "det":
        decades = range(-DET_DECADES, DET_DECADES + 1)
        return Legend(
            "det J: volume in base space for volume here",
            scale,
            tuple((d, f"{10.0**d:g}") for d in decades),
            "0 or less: folded, no diffeomorphism",
            LIGHT.folded,
        )
    ticks = np.linspace(0, scale.high, 5).tolist()
    return Legend(
        "Lyapunov value, square cm per second", scale, tuple((v, f"{v:g}") for v in ticks), "Every motion goes down"
    )
