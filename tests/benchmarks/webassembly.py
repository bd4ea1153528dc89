"""Compile the heart of a flow, a sum of Gaussians at many places, for a browser, and compare its speed with that here.

    python -m tests.benchmarks webassembly --places 2000 --centres 400

The loop is compiled by numba for this processor, and from numba's own code by LLVM for WebAssembly, which needs
`wasm-ld` (Debian: lld) and `node`, whose engine is Chromium's. Times are medians.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import llvmlite.binding as llvm
import numpy as np
from numba import cfunc, types
from numba.np.numpy_support import carray

from dt_viz.evaluate.options import TABLES, report, whole_number

OUT = TABLES
NUM_RUNS = 15
TRIPLE = "wasm32-unknown-unknown"
LAYOUT = "e-m:e-p:32:32-p10:8:8-p20:8:8-i64:64-n32:64-S128-ni:1:10:20"
"""Sizes and places of values in WebAssembly, as LLVM writes them."""
NODE = """
import fs from "fs";
const [file, numbers, num, many] = process.argv.slice(2);
const code = new WebAssembly.Module(fs.readFileSync(file)), env = {};
for (const { name } of WebAssembly.Module.imports(code)) env[name] = Math[name] || (() => { throw name; });
const exports = new WebAssembly.Instance(code, { env }).exports;
const loop = exports[Object.keys(exports).find((name) => name.startsWith("cfunc"))];
const memory = new Float64Array(exports.memory.buffer), begin = 1 << 20;
memory.set(new Float64Array(new Uint8Array(fs.readFileSync(numbers)).buffer), begin / 8);
const places = begin, centres = places + 24 * num, weights = centres + 24 * many, sums = weights + 24 * many;
const seconds = [];
for (let run = 0; run < RUNS; run++) {
    const before = performance.now();
    loop(places, centres, weights, sums, num, many, 0.5);
    seconds.push((performance.now() - before) / 1e3);
}
console.log(JSON.stringify([seconds, [...memory.slice(sums / 8, sums / 8 + 3 * num)]]));
""".replace("RUNS", str(NUM_RUNS))


def sum_gaussians(places, centres, weights, sums, num, many, steepness):
    """Write Σ_j w_j exp(−s‖x_i − c_j‖²) (num, 3) at places x (num, 3), of centres c and weights w (many, 3)."""
    x, c, w, out = (
        carray(places, (num, 3)),
        carray(centres, (many, 3)),
        carray(weights, (many, 3)),
        carray(sums, (num, 3)),
    )
    for i in range(num):
        first = second = third = 0.0
        for j in range(many):
            a, b, d = x[i, 0] - c[j, 0], x[i, 1] - c[j, 1], x[i, 2] - c[j, 2]
            bump = np.exp(-steepness * (a * a + b * b + d * d))
            first, second, third = first + bump * w[j, 0], second + bump * w[j, 1], third + bump * w[j, 2]
        out[i, 0], out[i, 1], out[i, 2] = first, second, third


def _compiled():
    array = types.CPointer(types.double)
    return cfunc(types.void(*[array] * 4, types.int32, types.int32, types.double), error_model="numpy")(sum_gaussians)


def write_object(path: Path) -> None:
    """Write the loop as an object file of WebAssembly; numba must not optimise it for this processor before."""
    code = re.sub(r"target triple = .*", f'target triple = "{TRIPLE}"', _compiled().inspect_llvm())
    code = re.sub(r"target datalayout = .*", f'target datalayout = "{LAYOUT}"', code)
    code = re.sub(r"= common global", "= internal global", code)  # which WebAssembly does not know
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    module = llvm.parse_assembly(code)
    machine = llvm.Target.from_triple(TRIPLE).create_target_machine(opt=3, reloc="static", features="+simd128")
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(3))
    builder.getModulePassManager().run(module, builder)
    path.write_bytes(machine.emit_object(module))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    parser.add_argument("--places", type=whole_number(1), default=2000, help="(default: %(default)s)")
    parser.add_argument("--centres", type=whole_number(1), default=400, help="(default: %(default)s)")


def run(options: argparse.Namespace) -> int:
    """Run the command; 1 where a program is missing, or the sums differ."""
    linker = shutil.which("wasm-ld") or shutil.which("wasm-ld-14")
    if linker is None or shutil.which("node") is None:
        print("found no wasm-ld, or no node; accepted: both, such as Debian's lld and nodejs")
        return 1
    num, many, generator = options.places, options.centres, np.random.default_rng(0)
    given = [generator.normal(size=(rows, 3)) for rows in (num, many, many)]
    sums, seconds = np.empty((num, 3)), []
    pointers = [array.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for array in (*given, sums)]
    native = _compiled().ctypes
    for _ in range(NUM_RUNS):
        began = time.perf_counter()
        native(*pointers, num, many, 0.5)
        seconds.append(time.perf_counter() - began)
    with TemporaryDirectory() as name:
        folder = Path(name)
        np.concatenate(given).tofile(folder / "numbers")
        (folder / "run.mjs").write_text(NODE)
        program = (
            f"import pathlib; from {__name__} import write_object; write_object(pathlib.Path({name!r}) / 'loop.o')"
        )
        plain = os.environ | {"NUMBA_OPT": "0"}
        subprocess.run([sys.executable, "-c", program], check=True, env=plain)
        link = ["--no-entry", "--export-all", "--allow-undefined", "--initial-memory=67108864"]
        subprocess.run([linker, *link, "-o", folder / "loop.wasm", folder / "loop.o"], check=True)
        command = ["node", folder / "run.mjs", folder / "loop.wasm", folder / "numbers", str(num), str(many)]
        times, found = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
        size = (folder / "loop.wasm").stat().st_size
    off = float(np.abs(np.reshape(found, (num, 3)) - sums).max())
    here, there = float(np.median(seconds)), float(np.median(times))
    report([{"here ms": 1e3 * here, "WebAssembly ms": 1e3 * there, "×": there / here, "kB": size / 1e3, "off by": off}])
    return 0 if off < 1e-9 else 1
