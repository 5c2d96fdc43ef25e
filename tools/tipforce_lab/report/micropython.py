"""Run code on MicroPython's WebAssembly build under Node.js, if both are installed."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from tipforce.errors import EnvironmentLackError

MODULE = Path(sys.prefix) / "micropython/node_modules/@micropython/micropython-webassembly-pyscript/micropython.mjs"
HEAP_BYTES = 64 << 20  # this build collects garbage only between runs
TIMEOUT_S = 120
_LAST_CHARACTERS = 200
_LAUNCHER = """
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";
const job = JSON.parse(readFileSync(0, "utf8"));
const { loadMicroPython } = await import(pathToFileURL(job.module).href);
const lines = [];
const stdout = (line) => lines.push(line);
const python = await loadMicroPython({ heapsize: job.heap, pystack: 16384, stdout, linebuffer: true });
for (const [path, text] of Object.entries(job.files)) python.FS.writeFile(path, text);
try {
    for (const call of job.calls) python.runPython(call);
} catch (error) {
    process.stderr.write(`${error.message}\\n`);
    process.exitCode = 1;
}
process.stdout.write(lines.map((line) => line + "\\n").join(""));
"""


def run(files: Mapping[str, str], calls: Sequence[str]) -> list[str]:
    """Run ``calls`` in sequence with ``files`` in the root of the file system; return the lines printed.

    Raises EnvironmentLackError if Node.js or MicroPython is missing, or the code fails.
    """
    node = shutil.which("node")
    if node is None:
        raise EnvironmentLackError("Node.js, which runs MicroPython here, is not installed (apt: nodejs)")
    if not MODULE.exists():
        raise EnvironmentLackError("MicroPython is not installed in this environment: run tools/bootstrap.sh test")
    job = {"files": dict(files), "calls": list(calls), "heap": HEAP_BYTES, "module": str(MODULE)}
    command = [node, "--input-type=module", "-e", _LAUNCHER]
    try:
        done = subprocess.run(
            command, input=json.dumps(job), capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise EnvironmentLackError(f"MicroPython did not finish within {TIMEOUT_S} s") from None
    if done.returncode:
        raise EnvironmentLackError(f"MicroPython failed: {done.stderr.strip()[-_LAST_CHARACTERS:]}")
    return done.stdout.splitlines()
