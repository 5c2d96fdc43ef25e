"""`tipforce node`: what its flags make, without a loop that runs."""

from __future__ import annotations

from pathlib import Path

import can
import pytest

from canopen_device.core.node import Device
from host.bus_with_nodes import new_channel
from tipforce.dictionary.eds import eds_text
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
