"""Coverage-guided fuzzing of the SDO server and of what start-up reads from storage; run by hand.

    pip install atheris
    python -m bench.atheris_sdo sdo -max_total_time=60
    python -m bench.atheris_sdo storage -max_total_time=60

Further arguments go to libFuzzer (a corpus directory, -runs=N, ...). It stops at the first exception.
"""

from __future__ import annotations

import binascii
import contextlib
import importlib
import struct
import sys
from typing import Any

try:
    atheris: Any = importlib.import_module("atheris")
except ImportError:
    atheris = None

# What is to guide the fuzzer must be imported under its eyes.
with atheris.instrument_imports(include=["tipforce"]) if atheris is not None else contextlib.nullcontext():
    from tipforce.fingertip.node import fingertip_node
    from tipforce.sources.simulated import SimulatedSource

GROUPS = ("communication", "application", "calibration", "lss")
STRAIN_PER_NEWTON = ((8e-5, 1e-5, -2e-5), (-1e-5, 9e-5, 3e-5), (2e-5, -3e-5, 7e-5))
EDS = bytes(range(256)) * 8


_stored: dict[str, bytes] = {}
_device = fingertip_node(5, SimulatedSource(STRAIN_PER_NEWTON), load=_stored.get, eds=EDS)
_now_us = 0


def _restart() -> None:
    """Switch the one device off and on: building one anew for each input would take most of the time."""
    _device.lss.pending_node_id = 5
    _device._booted = False
    _device.requests.clear()
    _step(())


def _step(frames: tuple[tuple[int, bytes], ...], pause_us: int = 1000) -> None:
    global _now_us  # noqa: PLW0603
    _now_us += pause_us
    sent, due_us = _device.step(_now_us, frames)
    assert due_us >= _now_us
    assert all(len(content) <= 8 and can_id <= 0x7FF for can_id, content in sent)


def fuzz_sdo(data: bytes) -> None:
    """Eight bytes each are one request; the first byte of all says how much time lies between them."""
    _restart()
    pause_us = (1 + data[0]) ** 2 if data else 1
    for offset in range(1, len(data) - 7, 8):
        _step(((0x605, data[offset : offset + 8]),), pause_us)


def fuzz_storage(data: bytes) -> None:
    """A group of stored bytes with a CRC that is right: the node boots, starts and takes SYNCs."""
    if not data:
        return
    content = data[1:]
    _stored.clear()
    _stored[GROUPS[data[0] % len(GROUPS)]] = struct.pack("<I", binascii.crc32(content)) + content
    _restart()
    _step(((0x000, b"\x01\x00"), (0x080, b"")))
    _step(((0x080, b"\x01"),), 2_000_000)


TARGETS = {"sdo": fuzz_sdo, "storage": fuzz_storage}


def main() -> int:
    """Run as a command."""
    if len(sys.argv) < 2 or sys.argv[1] not in TARGETS:
        print(f"usage: python -m bench.atheris_sdo {'|'.join(TARGETS)} [libFuzzer arguments]", file=sys.stderr)
        return 2
    if atheris is None:
        print("atheris is not installed: pip install atheris (Linux and macOS), then run this again", file=sys.stderr)
        return 2
    target = TARGETS[sys.argv.pop(1)]
    atheris.Setup(sys.argv, target)
    atheris.Fuzz()
    return 0


if __name__ == "__main__":
    sys.exit(main())
