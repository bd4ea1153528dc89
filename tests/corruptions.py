"""One-line corruptions of the product, chosen at random: do the tests notice?

    python -m tests.corruptions --seed 1 --count 60

Each corruption turns a comparison, changes a sign, multiplies by 1.5, drops a term or exchanges two arguments, in a
copy of the checkout. Then the quick tests of its package and the laws run, and then all others, until one fails. What
survives is printed at the end: either it changes no result, or a test is missing.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Queue
from typing import Any

ROOT = Path(__file__).parents[1]
PACKAGES = sorted(folder.name for folder in (ROOT / "tests").iterdir() if (ROOT / "dt_viz" / folder.name).is_dir())
"""Packages that are corrupted: those with tests of their own."""
TURNED = {ast.Lt: ">", ast.Gt: "<", ast.LtE: ">=", ast.GtE: "<=", ast.Eq: "!=", ast.NotEq: "=="}
TURNED |= {ast.Is: "is not", ast.IsNot: "is", ast.In: "not in", ast.NotIn: "in"}
SECONDS = 1200
"""Time limit, seconds, of one run of tests; a corruption that makes the tests hang is noticed, too."""


@dataclass(frozen=True)
class Corruption:
    """A change of one expression, within one line of a file."""

    path: Path
    line: int
    kind: str
    before: str
    after: str
    start: int
    """Offset of the expression in the line, bytes."""

    @property
    def package(self) -> str:
        """Name of the package that is corrupted."""
        return self.path.relative_to(ROOT / "dt_viz").parts[0]

    def __str__(self) -> str:
        return f"{self.path.relative_to(ROOT)}:{self.line} {self.kind}: {self.before}  ->  {self.after}"

    def apply(self, root: Path) -> None:
        """Write the corrupted file into another checkout."""
        lines = self.path.read_bytes().split(b"\n")
        line, before = lines[self.line - 1], self.before.encode()
        assert line[self.start : self.start + len(before)] == before
        lines[self.line - 1] = line[: self.start] + self.after.encode() + line[self.start + len(before) :]
        (root / self.path.relative_to(ROOT)).write_bytes(b"\n".join(lines))


def turned(node: ast.AST, text: Callable[[ast.AST], str]) -> str | None:
    """Turn a comparison: < becomes >."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        return f"{text(node.left)} {TURNED[type(node.ops[0])]} {text(node.comparators[0])}"
    return None


def other_sign(node: ast.AST, text: Callable[[ast.AST], str]) -> str | None:
    """Exchange plus and minus."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return text(node.operand)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
        return f"{text(node.left)} {'-' if isinstance(node.op, ast.Add) else '+'} {text(node.right)}"
    return None


def scaled(node: ast.AST, text: Callable[[ast.AST], str]) -> str | None:
    """Multiply a number that is no whole one, a product or a quotient by 1.5."""
    is_number = isinstance(node, ast.Constant) and isinstance(node.value, float) and node.value != 0
    if is_number or (isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult | ast.Div | ast.MatMult)):
        return f"(1.5 * ({text(node)}))"
    return None


def dropped(node: ast.AST, text: Callable[[ast.AST], str]) -> str | None:
    """Drop the second term of a sum, or the second condition of two."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
        return text(node.left)
    return text(node.values[0]) if isinstance(node, ast.BoolOp) and len(node.values) == 2 else None


def exchanged(node: ast.AST, text: Callable[[ast.AST], str]) -> str | None:
    """Exchange the first two arguments of a call."""
    if not isinstance(node, ast.Call) or len(node.args) < 2 or any(isinstance(a, ast.Starred) for a in node.args[:2]):
        return None
    first, second = text(node.args[0]), text(node.args[1])
    whole = text(node)
    begin = len(text(node.func)) + 1
    rest = whole[begin:]
    if first == second or not rest.startswith(first) or second not in rest[len(first) :]:
        return None
    between, _, after = rest[len(first) :].partition(second)
    return whole[:begin] + second + between + first + after


KINDS = {"turned": turned, "sign": other_sign, "x 1.5": scaled, "dropped": dropped, "exchanged": exchanged}


def corruptions(path: Path) -> Iterator[Corruption]:
    """All corruptions of a file, except in texts, types and error messages."""
    source = path.read_text(encoding="utf-8")
    lines = source.encode().split(b"\n")

    def text(node: Any) -> str:
        return lines[node.lineno - 1][node.col_offset : node.end_col_offset].decode()

    for node in _computing(ast.parse(source)):
        if isinstance(node, ast.expr) and node.lineno == node.end_lineno:
            for kind, corrupt in KINDS.items():
                after = corrupt(node, text)
                if after is not None:
                    yield Corruption(path, node.lineno, kind, text(node), after, node.col_offset)


def _computing(node: ast.AST) -> Iterator[ast.AST]:
    """The node and those below it, without annotations, texts and what is raised."""
    if isinstance(node, ast.Raise | ast.JoinedStr | ast.Assert):
        return
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "bases"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _computing(child)


def chosen(seed: int, count: int) -> list[Corruption]:
    """Choose corruptions at random: each kind as often, and within a kind each place."""
    rng = random.Random(seed)
    by_kind: dict[str, list[Corruption]] = {kind: [] for kind in KINDS}
    for package in PACKAGES:
        for path in sorted((ROOT / "dt_viz" / package).rglob("*.py")):
            for corruption in corruptions(path):
                by_kind[corruption.kind].append(corruption)
    kinds = list(KINDS)
    return [rng.choice(by_kind[kinds[k % len(kinds)]]) for k in range(count)]


def noticed_by(corruption: Corruption, root: Path) -> str:
    """Run the tests in a copy of the checkout until one fails; return its name, or nothing."""
    corruption.apply(root)
    try:
        own = [f"tests/{corruption.package}", "tests/laws"]
        found = [*(root / "tests").glob("*/test_*.py"), *(root / "tests").glob("test_*.py")]
        rest = sorted(str(path.relative_to(root)) for path in found if f"tests/{path.parent.name}" not in own)
        for folders in (own, rest):
            failed = _failing(root, folders)
            if failed:
                return failed
        return ""
    finally:
        shutil.copyfile(corruption.path, root / corruption.path.relative_to(ROOT))


def _failing(root: Path, folders: Sequence[str], processes: str = "0") -> str:
    """The first of the tests in these folders that fails; empty if all pass."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", processes, "-p", "no:randomly", *folders]
    environment = os.environ | {"PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        run = subprocess.run(
            command, cwd=root, env=environment, capture_output=True, text=True, timeout=SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        return "a test that does not end"
    if run.returncode == 0:
        return ""
    failed = [line for line in run.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return failed[0].split(" - ")[0] if failed else f"exit {run.returncode}: {run.stdout[-200:]}"


def main() -> None:
    """Print each corruption with what notices it, and those that survive."""
    parser = argparse.ArgumentParser(description="Corrupt the product at random places; do the tests notice?")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", type=int, nargs="*", help="numbers of the corruptions to try; default: all")
    parser.add_argument("--passing", action="store_true", help="the tests are known to pass without a corruption")
    arguments = parser.parse_args()
    numbered = [
        (number, corruption)
        for number, corruption in enumerate(chosen(arguments.seed, arguments.count))
        if arguments.only is None or number in arguments.only
    ]
    survivors: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        copies: Queue[Path] = Queue()
        roots = [_copy(Path(folder) / str(job)) for job in range(arguments.jobs)]
        if not arguments.passing and (failed := _failing(roots[0], ["tests"], "auto")):
            sys.exit(f"{failed} fails without any corruption")
        for root in roots:
            copies.put(root)

        def attempt(item: tuple[int, Corruption]) -> None:
            number, corruption = item
            copy = copies.get()
            by = noticed_by(corruption, copy)
            copies.put(copy)
            print(f"{number:3} {corruption}\n      {by or 'SURVIVES'}", flush=True)
            if not by:
                survivors.append(f"{number:3} {corruption}")

        with ThreadPoolExecutor(arguments.jobs) as pool:
            list(pool.map(attempt, numbered))
    print(f"\n{len(numbered) - len(survivors)} of {len(numbered)} are noticed; not:", *sorted(survivors), sep="\n")


def _copy(folder: Path) -> Path:
    """Copy the files of the checkout, those not committed yet, too."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in filter(None, subprocess.check_output(command, cwd=ROOT, text=True).split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, folder / name)
    return folder


if __name__ == "__main__":
    main()
