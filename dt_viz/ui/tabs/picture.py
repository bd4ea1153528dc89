"""The tab "Picture": how the scene is looked at, saved and presented."""

from __future__ import annotations

import html
from collections.abc import Callable
from functools import partial

import viser

from dt_viz.errors import Cancelled, FormatError, end_if
from dt_viz.pictures.video import VIDEO_SUFFIXES
from dt_viz.scheduler import checkpoint
from dt_viz.session.session import Session
from dt_viz.ui import patches
from dt_viz.ui.bindings import Bindings, Control
from dt_viz.ui.host import Host
from dt_viz.ui.scene.camera import HAND, HOME, VIEWS, CameraController, Framing
from dt_viz.ui.scene.export import FORMATS, MOTION, RESOLUTIONS, TURNTABLE, WARP, Order
from dt_viz.ui.scene.figure import Step
from dt_viz.ui.tabs.about import Command
from dt_viz.warning import Severity

CANCEL = "Cancel"
Make = Callable[[Session, Step, Cancelled], tuple[str, bytes]]
"""Function that makes a file; it returns the suffix and the content, and raises FormatError where there is none."""


class SaveButton:
    """A button that makes and sends one file at a time; while it does so, it is the one that cancels that.

    A bar below it shows progress, once a file's maker has told any.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        bindings: Bindings,
        label: str,
        make: Make,
        send: Callable[[str, bytes], None],
        *,
        icon: viser.IconName,
        hint: str,
    ) -> None:
        """Build the button where the panel is being built; its lane of the session's jobs has this `label`."""
        self._lane = self._label = label
        self._make, self._send = make, send
        self.button = gui.add_button(label, icon=icon, hint=hint)
        self._bar = gui.add_progress_bar(0.0, visible=False, animated=True)
        bindings.on(self.button, self._press)

    def rename(self, label: str) -> None:
        """Give the button another label, once it does not cancel."""
        self._label = label
        if self.button.label != CANCEL:
            self.button.label = label

    def _press(self, session: Session, _pressed: bool) -> None:
        if session.jobs.busy(self._lane):
            session.jobs.submit(self._lane, lambda: None, latest=True)
        else:
            session.jobs.submit(self._lane, partial(self._work, session))

    def _work(self, session: Session) -> None:
        cancelled = partial(session.jobs.superseded, self._lane)

        def step(fraction: float) -> None:
            end_if(cancelled)
            checkpoint()
            self._bar.value, self._bar.visible = 100 * fraction, True

        label, self.button.label = self._label, CANCEL
        try:
            suffix, content = self._make(session, step, cancelled)
            end_if(cancelled)
            self._send(suffix, content)
        except (FormatError, TimeoutError) as error:
            session.say(f"{label}: {error}", Severity.WARNING)
        finally:
            self.button.label, self._bar.visible = self._label, False
            self._bar.value = 0.0


LARGER = 1.4  # factor by which the panel, its type and its controls are larger for a projector
PNG = "PNG"
VIDEOS = tuple(suffix[1:].upper() for suffix in VIDEO_SUFFIXES)  # names of the formats of videos
LARGEST_VIDEO = "1920 × 1080"  # largest of the `RESOLUTIONS` that a video may have
SAVE_PICTURE, SAVE_VIDEO = "Save picture", "Save video"
BACK, ON, END = "Previous", "Next", "End"


class PictureTab:
    """The controls of one visitor's camera, theme and size of type, pictures and presentation."""

    def __init__(
        self,
        gui: viser.GuiApi,
        bindings: Bindings,
        page: Host,
        presentation: Presentation,
        enlarge: Callable[[bool], None],
    ) -> None:
        """Build the controls where the panel is being built; `enlarge` shows large type, or the usual one."""
        self._tripod = tripod = page.camera
        gui.add_html(patches.ROW)
        Control(gui.add_button_group("View", (*VIEWS, HAND, HOME), hint="where the camera looks from"), tripod.view)

        def box(label: str, hint: str) -> viser.GuiCheckboxHandle:
            return gui.add_checkbox(label, False, hint=hint)

        orbit = box("Orbit", "turns slowly around what is shown; where you move the camera, it goes on from there")
        self._orbit = Control(orbit, partial(setattr, tripod, "orbits"))
        lock = box("Lock camera", "no drag, wheel or key moves the camera; its views, the orbit and another scene do")
        self._lock = Control(lock, partial(setattr, tripod, "locked"))
        dark = box("Dark theme", "for a dark room; pictures that are saved stay light")
        self._dark = bindings.later(dark, lambda _session, on: page.darken(on))
        big = box("Big type", "larger type and controls in a wider panel, to be read from afar")
        self._big = Control(big, enlarge)
        hint = "the scene and a caption alone"
        alone = gui.add_button("Presentation", icon=viser.Icon.PRESENTATION, hint=hint)
        Control(alone, lambda _pressed: presentation.show(True))
        formats = tuple(suffix[1:].upper() for suffix in FORMATS)
        hint = (
            "PNG: the scene as you see it; SVG, PDF: lines and text for a paper, seen from the plane of the task; HTML:"
            " a page that plays the motion, and can be turned, without a server or network; MP4, GIF: a video"
        )
        self._format = Control(gui.add_dropdown("Save as", formats, hint=hint), self._choose)
        hint = (
            "your browser renders it frame by frame, so keep the page in sight; the robot waits meanwhile, and an edit "
            "ends it. Turntable: once around what is in the middle of the picture; warp: from 0 to 1"
        )
        self._what = Control(gui.add_dropdown("Video of", (MOTION, TURNTABLE, WARP), visible=False, hint=hint))
        self._resolution = Control(gui.add_dropdown("Resolution", tuple(RESOLUTIONS), hint="of the PNG, pixels"))
        self._transparent = Control(gui.add_checkbox("Transparent", False, hint="the PNG has no background"))

        def make(_session: Session, step: Step, cancelled: Cancelled) -> tuple[str, bytes]:
            suffix, size = f".{self._format.value.lower()}", RESOLUTIONS[self._resolution.value]
            is_clear = self._transparent.value and self._format.value == PNG
            return suffix, page.studio.picture(Order(suffix, size, is_clear, self._what.value), step, cancelled)

        hint = "of the scene, as a file; press again to cancel"
        self._save = SaveButton(gui, bindings, SAVE_PICTURE, make, page.send, icon=viser.Icon.CAMERA, hint=hint)

    @property
    def commands(self) -> list[Command]:
        """What the controls do; Home, which frames all again, comes first."""
        views = [Command(f"View: {name}", lambda _, name=name: self._tripod.view(name)) for name in (*VIEWS, HAND)]
        return [
            Command("Frame: move the camera back", lambda _: self._tripod.view(), "F"),
            *views,
            Command("Orbit: turn the camera slowly, or stop", lambda _: self._orbit.switch(), "O"),
            Command("Lock the camera, or let it go", lambda _: self._lock.switch(), "L"),
            Command("Theme: dark, or light", lambda _: self._dark.switch(), "T"),
            Command("Big type for a projector, or the usual one", lambda _: self._big.switch(), "B"),
        ]

    def _choose(self, chosen: str) -> None:
        is_video, resolutions = chosen in VIDEOS, tuple(RESOLUTIONS)
        self._transparent.handle.visible = chosen == PNG
        self._what.handle.visible = is_video
        self._resolution.handle.visible = is_video or chosen == PNG
        offered = resolutions[: resolutions.index(LARGEST_VIDEO) + 1] if is_video else resolutions
        if self._resolution.value not in offered:
            self._resolution.value = LARGEST_VIDEO
        self._resolution.handle.options = offered
        self._save.rename(SAVE_VIDEO if is_video else SAVE_PICTURE)


def big_type(gui: viser.GuiApi, tripod: CameraController) -> Callable[[bool], None]:
    """Return what shows large type beside a wider panel, or the usual one.

    Its style must be added outside tabs and folders, of which closed ones have none.
    """
    # viser measures its page in rem or em, of 92.5 % of the browser's type; on a phone the panel fills the window
    text = f"<style>@media (min-width: 577px) {{ :root {{ font-size: {92.5 * LARGER}%; }} }}</style>"
    style, usual = gui.add_html(text, visible=False), 320.0  # width of viser's panel, CSS pixels

    def show(on: bool) -> None:
        wider = (LARGER - 1) * usual if on else 0.0
        style.visible = on
        gui.main_panel.set_width(usual + wider)
        tripod.reframe(panel=Framing.panel + wider)

    return show


class Presentation:
    """Title and caption of what is shown, in place of the panel while it is on."""

    def __init__(self, gui: viser.GuiApi, turn: Callable[[int], None], present: Callable[[bool], None]) -> None:
        """Build its controls where the panel is being built, hidden; `turn`, by so many scenes, must only submit."""
        self._panel, self._turn, self._present = gui.main_panel, turn, present
        self._texts = {"title": "", "caption": ""}
        self._html = gui.add_html("", visible=False)
        self._buttons = gui.add_button_group("Presentation", (BACK, ON, END), visible=False)
        Control(self._buttons, self._press)

    @property
    def on(self) -> bool:
        """Whether the panel is hidden, and the caption shown."""
        return self._html.visible

    @property
    def title(self) -> str:
        """Title of what is shown, as HTML."""
        return self._texts["title"]

    @property
    def commands(self) -> list[Command]:
        """Begin and end it; the scenes can be turned with the panel, too."""
        return [
            Command("Presentation: the scene without the panel, or with it", lambda _: self.show(not self.on), "P"),
            Command("Next scene", lambda _: self._turn(1), "pagedown"),
            Command("Previous scene", lambda _: self._turn(-1), "pageup"),
        ]

    def show(self, on: bool) -> None:
        """Begin it, or end it."""
        if on != self.on:
            if on:
                self._panel.expand()  # what is folded away has no caption either
            self._html.visible = self._buttons.visible = on
            self._present(on)

    def write(self, **texts: str) -> None:
        """Change the title of what is shown, or the caption that says what to see."""
        self._texts |= {name: html.escape(text) for name, text in texts.items()}
        shown = "<h1>{title}</h1><p>{caption}</p>".format(**self._texts)
        self._html.content = f"{patches.ALONE}<div class='dt-caption'>{shown}</div>"

    def _press(self, button: str) -> None:
        if button == END:
            self.show(False)
        else:
            self._turn(1 if button == ON else -1)
