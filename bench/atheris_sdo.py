"""Coverage-guided fuzzing of the SDO server and of what start-up reads from storage; run by hand.

    pip install atheris
    python -m bench.atheris_sdo sdo|storage -max_total_time=60

Further arguments go to libFuzzer (a corpus directory, -runs=N, ...). It stops at the first exception."""

import importlib
import sys
from typing import Any

GROUPS = ("communication", "application", "calibration", "lss")


class Rig:
    """One node that is switched off and on: building one for each input would take most of the time."""

    def __init__(self) -> None:
        from bench.fuzz import STRAIN_PER_NEWTON

        from tipforce.fingertip.node import fingertip_node
        from tipforce.sources.simulated import SimulatedSource

        self._stored: dict[str, bytes] = {}
        source = SimulatedSource(STRAIN_PER_NEWTON)
        self._device = fingertip_node(5, source, load=self._stored.get, eds=bytes(range(256)) * 8)
        self._now_us = 0

    def _restart(self) -> None:
        self._device.lss.pending_node_id = 5
        self._device._booted = False
        self._device.requests.clear()
        self._step(())

    def _step(self, frames: tuple[tuple[int, bytes], ...], pause_us: int = 1000) -> None:
        self._now_us += pause_us
        sent, due_us = self._device.step(self._now_us, frames)
        assert due_us >= self._now_us
        assert all(len(content) <= 8 and can_id <= 0x7FF for can_id, content in sent)

    def sdo(self, data: bytes) -> None:
        """Eight bytes each are one request; the first byte of all says how much time lies between them."""
        self._restart()
        pause_us = (1 + data[0]) ** 2 if data else 1
        for offset in range(1, len(data) - 7, 8):
            self._step(((0x605, data[offset : offset + 8]),), pause_us)

    def storage(self, data: bytes) -> None:
        """A group of stored bytes with a CRC that is right: the node boots, starts and takes SYNCs."""
        if data:
            from canopen_device.core.storage import with_crc

            self._stored.clear()
            self._stored[GROUPS[data[0] % len(GROUPS)]] = with_crc(data[1:])
            self._restart()
            self._step(((0x000, b"\x01\x00"), (0x080, b"")))
            self._step(((0x080, b"\x01"),), 2_000_000)


def main() -> None:
    if len(sys.argv) < 2 or sys.argv[1] not in ("sdo", "storage"):
        raise SystemExit("usage: python -m bench.atheris_sdo sdo|storage [libFuzzer arguments]")
    try:
        atheris: Any = importlib.import_module("atheris")
    except ImportError:
        raise SystemExit("atheris is not installed: pip install atheris (Linux and macOS), then run again") from None
    # What guides the fuzzer is imported under its eyes.
    with atheris.instrument_imports(include=["canopen_device", "tipforce"]):
        rig = Rig()
    target = getattr(rig, sys.argv.pop(1))
    atheris.Setup(sys.argv, target)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
