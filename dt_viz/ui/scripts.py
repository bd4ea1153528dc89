"""Scripts on the page, beside viser's own: one sends several files at once, one reports the browser's window.

An upload button of viser sends one file. So files that are chosen or dropped together are packed into one zip archive,
without compression. Where scripts are not run, the button takes one file after another as it always does.

viser reports the size of its canvas in the pixels that it is drawn with: device pixels, at most two for each CSS pixel
at first, and fewer where drawing is slow. What lies beside the canvas, such as the panel, is measured in CSS pixels.
Nor does viser report what stands behind the `?` of the page's address. So a script writes both into a hidden text
input. Its value reaches the server as that of any control does, on the page's own websocket: another connection may be
served by another process, and proxies log its address.
"""

from __future__ import annotations

import html
import json
from collections.abc import Callable, Sequence
from typing import Annotated, Literal, get_args

import msgspec
import viser

from dt_viz.ui import patches
from dt_viz.ui.bindings import Control

NARROWEST, WIDEST = 240, 20_000  # widths that a window can have, CSS pixels
LONGEST = 100  # largest number of characters of a name in a link, and of a presenter's key
Kind = Literal["scene", "task", "tour", "scenario"]
KINDS: tuple[Kind, ...] = get_args(Kind)  # kinds of things that a link may open
REPORT = """
const mark = this.parentElement, page = new window.URL(location.href);
let found = {}, timer;
const take = name => {
  const value = page.searchParams.get(name);
  page.searchParams.delete(name);
  return value?.slice(0, LONGEST);
};
for (const kind of KINDS) {
  const name = take(kind);
  if (name !== undefined) found.link ??= {kind, name};
}
const kept = 'dt-viz-present', key = take('present');
if (key) found.key = key;
try {
  if (key) sessionStorage.setItem(kept, key);
  else if (sessionStorage.getItem(kept)) found.key = sessionStorage.getItem(kept);
} catch { if (key) page.searchParams.set('present', key); }
history.replaceState(history.state, '', page);
const report = () => {
  if (!mark.isConnected) return;
  const input = mark.nextElementSibling?.querySelector('input');
  if (!input) return timer = setTimeout(report, 100);
  const value = JSON.stringify({width: innerWidth, ...found});
  Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set.call(input, value);
  input.dispatchEvent(new Event('input', {bubbles: true}));
  found = {};
};
const resized = () => {
  if (!mark.isConnected) return window.removeEventListener('resize', resized);
  clearTimeout(timer);
  timer = setTimeout(report, 200);
};
window.addEventListener('resize', resized);
report();
"""
"""Writes the window's width, the link and the presenter's key into the text input after it, and new widths later.

KINDS are the kinds of links that are read and taken out of the address: a reload then goes on with what was made of the
link. The key is taken out, too, and kept by the tab, which reports it again after a reload; where a tab keeps nothing,
the key stays in the address.
"""
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

FORGET = """
const page = new window.URL(location.href);
try { sessionStorage.removeItem('dt-viz-present'); } catch {}
page.searchParams.delete('present');
history.replaceState(history.state, '', page);
"""
"""Takes a presenter's key out of the tab's storage and out of the address."""


class Link(msgspec.Struct, frozen=True):
    """What the address of a page asks for, such as `/?scene=fig-4`."""

    kind: Kind
    name: Annotated[str, msgspec.Meta(max_length=LONGEST)]
    """Name of a scene, a task or a scenario, or number of a step of the tour, from 1; empty for the first step."""


class Window(msgspec.Struct, frozen=True):
    """Report of a page on its browser window."""

    width: Annotated[int, msgspec.Meta(ge=NARROWEST, le=WIDEST)]  # CSS pixels
    link: Link | None = None
    """What the page's address asked for; None if nothing, and in later reports."""
    key: Annotated[str, msgspec.Meta(max_length=LONGEST)] = ""
    """Presenter's key; empty if the page has none, and in later reports."""


def report_window(client: viser.ClientHandle, act: Callable[[Window], None], kinds: Sequence[Kind] = ()) -> None:
    """Have a page report its window when it is shown, and when its width changes.

    Args:
        client: visitor whose page it is.
        act: called with each valid report, on the server's event loop; it must only submit.
        kinds: kinds of links that are read; others stay in the address.
    """

    def reported(text: str) -> None:
        try:
            window = msgspec.json.decode(text, type=Window)
        except (msgspec.MsgspecError, UnicodeError):
            return
        act(window)

    script = REPORT.replace("KINDS", json.dumps([*kinds])).replace("LONGEST", str(LONGEST))
    with client.atomic():
        client.gui.add_html(patches.UNSEEN + _run(script))
        Control(client.gui.add_text("Window", ""), reported)


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
