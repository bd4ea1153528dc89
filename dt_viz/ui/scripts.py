"""Scripts on the page, beside viser's own: one sends several files at once, one tells what the window is and shows.

An upload button of viser sends one file. So files that are chosen or dropped together are packed into one zip archive,
without compression. Where scripts are not run, the button takes one file after another as it always does.

viser's page reports the size of its canvas in the pixels that it is drawn with: device pixels, at most two for each CSS
pixel at first, and fewer where drawing is slow. What lies beside the canvas, such as the panel, is measured in CSS
pixels. So the page asks for an address that has the width in it, again whenever that changes.

The server is not told what the address of the page says behind its `?`, as viser connects without that. So the page
asks for an address that has it, too, and takes it out of its own: a reload goes on with what was made of it. The key of
a presenter is told likewise, and is kept by the tab.
"""

from __future__ import annotations

import html
import re
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from urllib.parse import unquote

import viser

from dt_viz.ui import patches

FOLDER = "window"
NARROWEST, WIDEST = 240, 20_000
"""Widths that a window can have, CSS pixels."""
LONGEST = 100
"""Largest number of characters of a name in a link."""
MEASURE = """
clearTimeout(window.dtVizTells);
window.removeEventListener('resize', window.dtVizResized);
const tell = () => fetch('ADDRESS/' + innerWidth, {cache: 'no-store'});
window.dtVizResized = () => { clearTimeout(window.dtVizTells); window.dtVizTells = setTimeout(tell, 200); };
window.addEventListener('resize', window.dtVizResized);
tell();
const page = new window.URL(location.href), kinds = KINDS.filter(kind => page.searchParams.has(kind));
for (const kind of kinds.slice(0, 1))
  fetch('ADDRESS/' + kind + '/' + encodeURIComponent(page.searchParams.get(kind)), {cache: 'no-store'});
for (const kind of kinds) page.searchParams.delete(kind);
if (kinds.length) history.replaceState(history.state, '', page);
"""
"""Tells the width, and which of the KINDS of things is to be begun; ADDRESS is what is asked for."""
DROP = """
const input = document.getElementById('file_upload_' + BUTTON);
if (!input || input.multiple) return;
const table = Array.from({length: 256}, (_, n) => {
  for (let k = 0; k < 8; k++) n = n & 1 ? 0xEDB88320 ^ (n >>> 1) : n >>> 1;
  return n >>> 0;
});
const crc32 = bytes => {
  let value = ~0;
  for (const byte of bytes) value = table[(value ^ byte) & 255] ^ (value >>> 8);
  return ~value >>> 0;
};
const record = (...fields) => {
  const view = new DataView(new ArrayBuffer(fields.reduce((sum, [size]) => sum + size, 0)));
  let at = 0;
  for (const [size, value] of fields) {
    size === 2 ? view.setUint16(at, value, true) : view.setUint32(at, value, true);
    at += size;
  }
  return view.buffer;
};
const packed = async files => {
  const parts = [], central = [];
  let at = 0, length = 0;
  for (const [path, file] of files) {
    const bytes = new Uint8Array(await file.arrayBuffer()), name = new TextEncoder().encode(path);
    const size = bytes.length, common = [[2, 20], [2, 0x800], [2, 0], [2, 0], [2, 33], [4, crc32(bytes)], [4, size],
      [4, size], [2, name.length], [2, 0]];
    parts.push(record([4, 0x04034b50], ...common), name, bytes);
    central.push(record([4, 0x02014b50], [2, 20], ...common, [2, 0], [2, 0], [2, 0], [4, 0], [4, at]), name);
    at += 30 + name.length + size;
    length += 46 + name.length;
  }
  const end = record([4, 0x06054b50], [2, 0], [2, 0], [2, files.length], [2, files.length], [4, length], [4, at],
    [2, 0]);
  return new File([...parts, ...central, end], files.length + ' files.zip');
};
const give = file => {
  const transfer = new DataTransfer();
  transfer.items.add(file);
  input.files = transfer.files;
  input.dispatchEvent(new Event('change', {bubbles: true}));
};
const send = async files => {
  const large = files.find(([, file]) => file.size > MOST);
  if (large || files.length === 1) give((large || files[0])[1]);
  else if (files.length) give(await packed(files));
};
const within = async entry => {
  if (entry.isFile) return [[entry.fullPath.slice(1), await new Promise((done, fail) => entry.file(done, fail))]];
  const reader = entry.createReader(), found = [];
  for (;;) {
    const some = await new Promise((done, fail) => reader.readEntries(done, fail));
    if (!some.length) return found;
    for (const inner of some) found.push(...await within(inner));
  }
};
input.multiple = true;
input.addEventListener('change', event => {
  if (input.files.length < 2) return;
  event.stopPropagation();
  send(Array.from(input.files, file => [file.name, file]));
});
const target = () => input.isConnected && !input.nextElementSibling?.disabled;
const over = event => { if (target() && event.dataTransfer?.types.includes('Files')) event.preventDefault(); };
const drop = async event => {
  if (!target() || !event.dataTransfer?.files.length) return;
  event.preventDefault();
  const entries = Array.from(event.dataTransfer.items, item => item.webkitGetAsEntry()).filter(Boolean);
  const files = Array.from(event.dataTransfer.files, file => [file.name, file]);
  send(entries.length ? (await Promise.all(entries.map(within))).flat() : files);
};
window.dtVizForget?.();
document.addEventListener('dragover', over);
document.addEventListener('drop', drop);
window.dtVizForget = () => {
  document.removeEventListener('dragover', over);
  document.removeEventListener('drop', drop);
};
"""
"""Sends files; BUTTON is the button's name in the page, MOST the largest number of bytes of a file."""

ARROWS = """
const mark = this.parentElement, names = {ArrowLeft: BACK, ArrowRight: NEXT};
const press = event => {
  if (!mark.isConnected) return window.removeEventListener('keydown', press, true);
  const other = event.altKey || event.ctrlKey || event.metaKey || event.shiftKey;
  const taken = event.target.matches?.('input, textarea, select, [contenteditable], [role]');
  if (!names[event.key] || other || taken) return;
  event.stopPropagation();
  const buttons = event.repeat ? [] : Array.from(mark.nextElementSibling?.querySelectorAll('button') ?? []);
  buttons.find(button => button.textContent.trim() === names[event.key])?.click();
};
window.addEventListener('keydown', press, true);
mark.parentElement.firstElementChild.scrollIntoView({block: 'nearest'});
"""
"""Has the keys left and right press the buttons BACK and NEXT of the group that comes next, while they are there.

The page's camera, which these keys turn too, does not hear of it; what is typed in, and sliders, keep them.
"""

PRESENT = """
const name = 'dt-viz-present', page = new window.URL(location.href);
let key = page.searchParams.get('present');
try {
  if (key) sessionStorage.setItem(name, key);
  else key = sessionStorage.getItem(name);
  page.searchParams.delete('present');
  history.replaceState(history.state, '', page);
} catch {}
if (key) fetch('ADDRESS/present/' + encodeURIComponent(key), {cache: 'no-store'});
"""
"""Tells the key of a presenter, and takes it out of the address: the tab keeps it, and tells it again after a reload.

Where nothing is kept it stays in the address.
"""
FORGET = "try { sessionStorage.removeItem('dt-viz-present'); } catch {}"
"""Keeps the key no longer."""

KINDS = ("scene", "task", "tour", "scenario")
"""Kinds of things that a link may ask for."""


@dataclass(frozen=True)
class Link:
    """What the address of a page asks for, such as `/?scene=fig-4`."""

    kind: str
    """One of `KINDS`."""
    name: str
    """Name of a scene, a task or a scenario, or number of a step of the tour, from 1; the first one if empty."""


Told = Callable[[str, "float | Link | Claim"], None]
"""Callback that takes the token of a ruler, and the width of its window, CSS pixels, the link's wish, or a key."""


class Ruler:
    """Measures the window of one visitor, and reads its link."""

    def __init__(self) -> None:
        self.token = secrets.token_urlsafe(12)
        """Name of this ruler in requests, which nobody else knows."""

    @property
    def html(self) -> str:
        """What is to stand on the page, unseen."""
        return self._measures(KINDS)

    @property
    def asking_html(self) -> str:
        """HTML that measures the window and tells the presenter's key; the rest of the link stays in the address."""
        return self._measures(()) + _run(PRESENT.replace("ADDRESS", f"{FOLDER}/{self.token}"))

    def _measures(self, kinds: Sequence[str]) -> str:
        return _run(MEASURE.replace("ADDRESS", f"{FOLDER}/{self.token}").replace("KINDS", str([*kinds])))


@dataclass(frozen=True)
class Claim:
    """The claim to be the presenter."""

    key: str


def told(path: str) -> tuple[str, float | Link | Claim] | None:
    """Return the token, and the width, CSS pixels, the link or the key of a request's path; None if it has none."""
    claimed = re.search(rf"/{FOLDER}/([\w-]+)/present/([\w-]{{1,{LONGEST}}})$", path, re.ASCII)
    if claimed:
        return claimed[1], Claim(claimed[2])
    asked = re.search(rf"/{FOLDER}/([\w-]+)/({'|'.join(KINDS)})/([\w.!~*'()%-]{{0,{LONGEST}}})$", path, re.ASCII)
    if asked:
        return asked[1], Link(asked[2], unquote(asked[3])[:LONGEST])
    found = re.search(rf"/{FOLDER}/([\w-]+)/(\d{{3,5}})$", path, re.ASCII)
    return (found[1], float(found[2])) if found and NARROWEST <= int(found[2]) <= WIDEST else None


def drop_html(button: viser.GuiUploadButtonHandle, most: int) -> str:
    """Return what is to stand beside an upload button on the page, unseen; files are of so many bytes at most."""
    return _run(DROP.replace("BUTTON", repr(patches.name_of(button))).replace("MOST", str(most)))


def arrows_html(back: str, following: str) -> str:
    """Return what is to stand before a group of buttons on the page, unseen; these are the names of two of them."""
    return _run(ARROWS.replace("BACK", repr(back)).replace("NEXT", repr(following)))


def forget_html() -> str:
    """Return HTML that makes the tab of a former presenter forget the key."""
    return _run(FORGET)


def _run(script: str) -> str:
    """Return what runs a script where it is on the page, and is not seen."""
    return f'<img src="data:," alt="" hidden onerror="{html.escape(f"(() => {{{script}}})()")}">'
