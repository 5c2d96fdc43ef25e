"""A simulated finger of `tipforce node` is calibrated as a delivered one."""

from __future__ import annotations

import binascii
import math
import struct
from pathlib import Path

import pytest

from canopen_device.core import codes
from canopen_device.core.node import Device
from tipforce.scene.delivered import beam_calibration, commit_calibration, download
from tools.rig import run_node

SYNC, RESET_NODE = (0x80, b""), (0x000, b"\x81\5")
FIVE = 'points = ["K_H", "S_H", "U", "L", { beam = "V", side = "left", position_mm = 3.0 }]\n'
LOAD = (4.4, 90.0, 45.0)


def contact(device: Device, at_us: int) -> tuple[float, float, float]:
    """P in newtons, phi and theta in degrees, of a sample at that time."""
    device.step(at_us, [SYNC])
    first = int(device.od.get(0x1018, 2)) & 0xFF
    P, phi, theta = (device.od.get(0x6130, first + k) for k in (4, 5, 6))
    return P, phi, theta  # type: ignore[return-value]


@pytest.mark.parametrize("layout", ["I", "III'", "five.toml"])
@pytest.mark.parametrize("with_store", [False, True])
def test_a_simulated_finger_is_delivered_calibrated(
    layout: str, with_store: bool, devices: list[Device], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It measures its --load at once, and after reset node; its calibration has its serial, offsets and load sense."""
    monkeypatch.chdir(tmp_path)
    Path("five.toml").write_text(FIVE)
    offsets = ",".join(["12", "-8.5", "5.3", "100", "-40"][: 5 if layout == "five.toml" else 3])
    words = f"--layout {layout} --serial 77 --noise 0.1 --offset {offsets} --load 4.4,90,45 -q".split()
    assert run_node(*words, *(["--store", "store.json"] if with_store else [])) == 0
    (device,) = devices
    device.step(0)
    assert contact(device, 1_000_000) == pytest.approx(LOAD, abs=0.2)
    device.step(2_000_000, [RESET_NODE])
    assert contact(device, 3_000_000) == pytest.approx(LOAD, abs=0.2)
    assert (device.od.get(0x2102, 1), device.od.get(0x2110, 6), device.od.get(0x2103, 4)) == (77, 1, 1)
    assert (device.od.get(0x2102, 4), device.od.get(0x2112, 1)) == (1 if layout == "I" else 255, 15.0)
    assert list(tmp_path.glob("store*")) == [], "nothing is written until somebody stores"


def test_what_is_stored_comes_first(devices: list[Device], tmp_path: Path) -> None:
    """Also a restored default (1011h): nobody who erases a calibration finds another one."""
    words = ("-q", "--load", "4.4,90,45", "--store", str(tmp_path / "store.json"))
    stored = beam_calibration("II", pull=True)
    for signature, crc in ((codes.SIGNATURE_SAVE, stored.crc32()), (codes.SIGNATURE_LOAD, 0)):
        run_node(*words)
        device = devices[-1]
        device.step(0)
        commit_calibration(device, stored)
        index = 0x1010 if signature == codes.SIGNATURE_SAVE else 0x1011
        download(device, index, 4, struct.pack("<I", signature))
        run_node(*words)
        devices[-1].step(0)
        assert devices[-1].od.get(0x2103, 3) == crc


def test_other_settings_that_are_stored_leave_it_calibrated(devices: list[Device], tmp_path: Path) -> None:
    words = ("-q", "--store", str(tmp_path / "store.json"))
    run_node(*words)
    devices[0].step(0)
    record = devices[0].od.get(0x2140)
    assert isinstance(record, bytes)
    download(devices[0], 0x1017, 0, struct.pack("<H", 250))
    download(devices[0], 0x1010, 2, struct.pack("<I", codes.SIGNATURE_SAVE))
    run_node(*words)
    devices[1].step(0)
    assert (devices[1].od.get(0x1017), devices[1].od.get(0x2103, 3)) == (250, binascii.crc32(record))


def test_uncalibrated(devices: list[Device], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_node("--uncalibrated", "-q") == 0
    (tmp_path / "same.toml").write_text(
        "points = [" + ",".join(f'{{ beam = "V", side = "left", position_mm = {k} }}' for k in (1, 5, 9)) + "]"
    )
    assert run_node("--layout", tmp_path / "same.toml") == 0
    for device in devices:
        device.step(0)
        assert device.od.get(0x2103, 3) == 0
        assert all(map(math.isnan, contact(device, 1_000_000)))
    line = capsys.readouterr().err.splitlines()[0]
    gauges = "V left 1.00, V left 5.00, V left 9.00"
    assert line.startswith(f"node 5 (0x05): not calibrated: the gauges {gauges} have rank 2 in this geometry")
