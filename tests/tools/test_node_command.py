"""`tipforce node`: what its flags make, without a loop that runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import can
import pytest

from host.bus_with_nodes import new_channel
from tipforce.device.node import Device
from tipforce.dictionary.eds import eds_text
from tipforce.errors import InputError
from tipforce.fingertip.application import Fingertip
from tipforce.running import loop
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.layouts import LAYOUTS
from tipforce.sources.simulated import SimulatedSource
from tipforce_tools.cli.layout_file import read_layout
from tipforce_tools.cli.main import main


@pytest.fixture
def devices(monkeypatch: pytest.MonkeyPatch) -> list[Device]:
    """The devices that the loop was given; it ends at once, as by Ctrl-C, after one step each."""
    found: list[Device] = []

    def run(given: Sequence[Device], port: loop.Port, _stop: Callable[[], bool]) -> None:
        found.extend(given)
        for device in given:
            port.send(device.step(0)[0])
        raise KeyboardInterrupt

    monkeypatch.setattr(loop, "run", run)
    return found


def node(*words: str, channel: str = "") -> int:
    return main(["node", "--node-id", "5", "-i", "virtual", "-c", channel or new_channel(), *words])


def source_of(device: Device) -> SimulatedSource:
    assert isinstance(device.application, Fingertip)
    source = device.application.source
    assert isinstance(source, SimulatedSource)
    return source


def test_defaults(devices: list[Device], capsys: pytest.CaptureFixture[str]) -> None:
    channel = new_channel()
    with can.Bus(interface="virtual", channel=channel) as other:
        assert node(channel=channel) == 0
        boot_up = other.recv(1.0)
    assert boot_up is not None
    assert (boot_up.arbitration_id, bytes(boot_up.data)) == (0x705, b"\0")
    (device,) = devices
    assert device.node_id == 5
    assert device.od.get(0x1018, 4) == 5, "the serial number is the node-id"
    assert device.od.get(0x1021) == eds_text(3, simulated=True).encode()
    source = source_of(device)
    assert (source.noise_microstrain, source.load, source.offset_microstrain) == (0.5, (0.0, 0.0, 0.0), [0.0] * 3)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("node 5 (0x05): layout I, ")
    assert err.endswith("node 5 (0x05): stopped\n")


def test_flags(devices: list[Device], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = tmp_path / "node.json"
    words = [
        "--layout",
        "III",
        "--serial",
        "77",
        "--noise",
        "0",
        "--offset",
        "-1,2,3.5",
        "--load",
        "-4.4,90,-60",
        "--seed",
        "3",
        "-q",
        "--store",
    ]
    assert node(*words, str(store)) == 0
    (device,) = devices
    source = source_of(device)
    assert device.od.get(0x1018, 4) == 77
    assert source.offset_microstrain == [-1.0, 2.0, 3.5]
    assert source.load == (-4.4, 90.0, -60.0)
    assert capsys.readouterr() == ("", "")


def test_a_layout_file_with_more_gauges(devices: list[Device], tmp_path: Path) -> None:
    path = tmp_path / "four.toml"
    path.write_text('points = ["K_H", "S_H", "U", "L"]\n')
    assert node("--layout", str(path), "--offset", "1,2,3,4") == 0
    assert devices[0].od.get(0x1018, 2) == 0x54500104


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--source adc", "--source adc: allowed are sim, iio:DEVICE[,DEVICE...], replay:FILE"),
        ("--source iio:device0", "--layout I: the gauges of a real converter need a [bridge] table"),
        ("--layout IV", "layout 'IV': neither one of I, II, III"),
        ("--noise -1", "--noise -1.0: allowed is 0 to 1e+06"),
        ("--noise nan", "--noise nan: allowed is 0 to 1e+06"),
        ("--noise inf", "--noise inf: allowed is 0 to 1e+06"),
        ("--load 1,2", "--load '1,2': expected 3 numbers separated by commas"),
        ("--load 1,2,x", "--load '1,2,x': expected 3 numbers"),
        ("--load nan,0,0", "--load 'nan,0,0': expected 3 numbers"),
        ("--load 1,inf,0", "--load '1,inf,0': expected 3 numbers"),
        ("--offset 1,2", "--offset '1,2': expected 3 numbers"),
        ("--offset 1,2,nan", "--offset '1,2,nan': expected 3 numbers"),
        ("--store .", ": is a directory"),
        ("--store absent/x.json", "absent does not exist"),
    ],
)
def test_flags_that_are_wrong(
    devices: list[Device], words: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert node(*words.split()) == 2
    assert message in capsys.readouterr().err
    assert not devices


@pytest.mark.parametrize("node_id", ["0", "128", "five"])
def test_node_ids_that_are_wrong(node_id: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["node", "--node-id", node_id])
    assert caught.value.code == 2
    assert f"--node-id: node-id '{node_id}': allowed are 1 to 127" in capsys.readouterr().err


# --- layout files ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_layout_by_name(name: str) -> None:
    assert read_layout(name) == (FABRICATED, LAYOUTS[name])


def test_a_layout_with_a_geometry(tmp_path: Path) -> None:
    path = tmp_path / "layout.toml"
    wanted = replace(FABRICATED, r_m=0.02)
    lines = "\n".join(f"{name} = {value}" for name, value in asdict(wanted).items())
    path.write_text(f'points = ["L", "R", "U"]\n[geometry]\n{lines}\n')
    assert read_layout(str(path)) == (wanted, ("L", "R", "U"))
    path.write_text(path.read_text().replace("r_m = 0.02", "r_m = -1"))
    with pytest.raises(InputError, match=r"layout .*layout\.toml: geometry r_m = -1\.0: allowed is 1e-06 to 10 m"):
        read_layout(str(path))


def test_a_geometry_may_say_more(tmp_path: Path) -> None:
    path = tmp_path / "layout.toml"
    lines = "\n".join(f"{name} = {value}" for name, value in asdict(FABRICATED).items())
    path.write_text(f'points = ["L", "R", "U"]\n[geometry]\n{lines}\ndrawing = "A-12"\n')
    assert read_layout(str(path)) == (FABRICATED, ("L", "R", "U"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "layout.toml: points is missing"),
        ('points = ["K_H"]', "a layout of 1 gauge points: allowed are 3 to 8"),
        ('points = ["K_H", "S_H", "X"]', "gauge point X is not known: allowed are L, R"),
        ('points = ["K_H", "S_H", "K_H"]', "K_H is given more than once"),
        ("points = 5", "points is 5: allowed is a list"),
        (
            'points = ["L", "R", "U"]\ngauges = 3',
            "gauges: no such key; allowed: points, gauge_length_mm, geometry, bridge",
        ),
        ('points = ["L", "R", "U"]\n[geometry]\nr_m = "x"', "geometry.a_m is missing"),
        ('points = ["L", "R", 5]', "points[3] is 5: expected str | table, got int"),
        ('points = ["L", "R", "U"]\ngeometry = 5', "geometry is 5: allowed is a table"),
        (
            'points = ["L", "R", "U"]\n[geometry]\nr_mm = 0.01',
            "geometry.r_mm: no such key; did you mean r_m? allowed: a_m, d_m",
        ),
        ("points = [", "layout "),
    ],
)
def test_a_layout_file_that_is_wrong(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "layout.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_layout(str(path))
    assert message in str(caught.value).replace("'", "")
    assert str(path) in str(caught.value)


def test_a_layout_that_is_a_directory(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"layout .*Is a directory"):
        read_layout(str(tmp_path))
