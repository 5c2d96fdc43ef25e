"""`tipforce node`: what its flags make, without a loop that runs."""

from __future__ import annotations

import binascii
import math
import struct
from pathlib import Path

import can
import pytest

from canopen_device.core import codes
from canopen_device.core.node import Device
from host.bus_with_nodes import new_channel
from tipforce.dictionary.eds import eds_text
from tipforce.scene.delivered import beam_calibration, commit_calibration, download
from tipforce.sources.simulated import SimulatedSource
from tools.rig import run_node, source_of


def test_defaults(devices: list[Device], capsys: pytest.CaptureFixture[str]) -> None:
    channel = new_channel()
    with can.Bus(channel, interface="virtual") as bus:
        assert run_node(channel=channel) == 0
        last = bus.recv(0)
        assert last is not None
        assert (last.arbitration_id, bytes(last.data)) == (0x705, b"\4"), "it says that it stopped"
    (device,) = devices
    assert (device.node_id, device.step(0)[0][0]) == (5, (0x705, b"\0"))
    assert device.od.get(0x1018, 4) == 5, "the serial number is the node-id"
    assert device.od.get(0x1021) == eds_text(3, simulated=True).encode()
    source = source_of(device)
    assert isinstance(source, SimulatedSource)
    assert (source.noise_microstrain, source.load, source.offset_microstrain) == (0.5, (0.0, 0.0, 0.0), [0.0] * 3)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("node 5 (0x05): layout I, ")
    assert err.endswith("node 5 (0x05): stopped\n")


def test_flags(devices: list[Device], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = tmp_path / "node.json"
    words = "--layout III --serial 77 --noise 0 --offset -1,2,3.5 --load -4.4,90,-60 --seed 3 -q --store"
    assert run_node(*words.split(), store) == 0
    (device,) = devices
    source = source_of(device)
    assert isinstance(source, SimulatedSource)
    assert device.od.get(0x1018, 4) == 77
    assert source.offset_microstrain == [-1.0, 2.0, 3.5]
    assert source.load == (-4.4, 90.0, -60.0)
    assert capsys.readouterr() == ("", "")


def test_a_layout_file_with_more_gauges(devices: list[Device], tmp_path: Path) -> None:
    path = tmp_path / "four.toml"
    path.write_text('points = ["K_H", "S_H", "U", "L"]\n')
    assert run_node("--layout", str(path), "--offset", "1,2,3,4") == 0
    assert devices[0].od.get(0x1018, 2) == 0x54500104


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
