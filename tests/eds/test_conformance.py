"""The conformance suite and random frames on devices of other manufacturers: a missing feature is no fault."""

from __future__ import annotations

from pathlib import Path

import pytest
from bench import fuzz

from canopen_conformance.run import FAIL, PASS
from canopen_device.core.node import Device
from canopen_device.eds import read_eds
from canopen_device.eds.load import device_of
from canopen_device.machine import shipped_eds
from canopen_device.testing import MemoryStore
from conformance.fingertip import matching, run_in_process
from eds.samples import pdo, record, text, var

PLAIN = text(
    var("1003", 7, "ro", "0"), var("1005", 7, "ro", "128"), var("1009", 9, "const"),
    var("1014", 7, "ro", "0x80 + $NODEID"), var("1016", 7, "rw", "0"), var("1017", 6, "rw", "0"), var("1200", 7, "ro"),
)  # fmt: skip
HISTORY = record("1003", var("1003sub0", 5, "rw", "0"), var("1003sub1", 7, "ro"), var("1003sub2", 7, "ro"), code="0x8")
CONSUMER = record("1016", var("1016sub0", 5, "ro", "1"), var("1016sub1", 7, "rw", "0", HighLimit="65535"), code="0x8")
HIGHEST, HIGHER = var("1800sub0", 5, "const", "5"), var("1800sub0", 5, "const", "6")
INHIBIT, START = var("1800sub3", 6, "rw", "0"), var("1800sub6", 5, "rw", "0")
LIMITED = text(
    HISTORY, CONSUMER, var("1005", 7, "rw", "0x80", LowLimit="0x80", HighLimit="0x400000FF"), var("1017", 6, "rw", "0"),
    var("1014", 7, "rw", "$NODEID+0x80"), var("2000", 7), var("5FFF", 7), pdo(0x1400, "$NODEID+0x200", 255, 0x20000020),
    pdo(0x1800, "$NODEID+0x180", 255, 0x99990020).replace(INHIBIT, START).replace(HIGHEST, HIGHER),
)  # fmt: skip
PRODUCER = text(
    var("1005", 7, "rw", "0x40000080"), var("1006", 7, "rw", "10000"), var("1019", 5, "rw", "10"), var("2000", 5),
    var("1014", 7, "rw", "$NODEID+0x80"), var("1015", 6, "rw", "100"), pdo(0x1800, "$NODEID+0x180", 3, 0x20000008),
)  # fmt: skip
AREAS = ("emcy", "identity", "pdo_parameters", "sync", "tpdo", "sdo", "error_control.consumer", "lss.node_id_")
CASES = [case for area in AREAS for case in matching(area + ("*" if "." in area else ".*"))]


@pytest.mark.parametrize("content", [text(), PLAIN, LIMITED, PRODUCER], ids=["least", "plain", "limited", "producer"])
def test_no_case_fails(content: str, tmp_path: Path) -> None:
    path = tmp_path / "any.eds"
    path.write_text(content)

    def device() -> Device:
        store = MemoryStore()
        return device_of(read_eds(path, 5), store.save, store.load)

    results = [run_in_process(case, device())[0] for case in CASES]
    assert [(result.case.name, result.reason) for result in results if result.verdict == FAIL] == []
    assert sum(result.verdict == PASS for result in results) > 10


def test_random_frames_never_raise(tmp_path: Path) -> None:
    """A small share of `python -m bench.fuzz --eds`."""
    path = tmp_path / "generated.eds"
    path.write_text(fuzz.generated_eds(60))
    for file in (path, shipped_eds("cia402")):
        assert fuzz.fuzz_file(file, 2000, seed=17) > 500
