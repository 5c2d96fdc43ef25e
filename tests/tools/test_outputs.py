"""Outputs are safe: a failed write leaves the old file; no control character of a file or device is shown."""

import json
import re
import resource
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from canopen_device.core.node import Device
from canopen_device.eds import read_eds
from canopen_device.eds.load import device_of
from eds.samples import INFO, MANDATORY, record, var
from host.bus_with_nodes import connected, finger
from host.logs.test_pcap import block, socketcan
from tipforce.errors import InputError, WriteError
from tipforce.host.configuration.calibration import write_calibration
from tipforce.output_file import CALIBRATION, NewFile, new_file, write_file
from tipforce.scene import beam_calibration
from tipforce.sensor.calibration.simulation import simulate
from tipforce_tools.cli.main import COMMANDS
from tools.blocks import CONTACTS_LOG
from tools.rig import Printed, exit_code, files, write_readings
from tools.test_log import counting

SCENE = """
duration_s = 0.05
sync_hz = 200
nodes = [{ ids = [1], pdos = ["contact"] }]
loads = [{ kind = "static", P_N = 2.0, phi_deg = -90, theta_deg = 80 }]
[outputs]
"""

TOML, SVG, PNG, CSV = b"[calibration]\nold = 1\n", b"<svg/>\n", b"\x89PNG old", b"a,b\n1,2\n"
WRITES: list[tuple[str, str, bytes]] = [
    ("calibrate fit data.csv --saturation none -o cal2.toml", "cal2.toml", TOML),
    ("estimate cal.toml readings.csv -o out.csv", "out.csv", CSV),
    ("estimate cal.toml readings.csv --json -o out.jsonl", "out.jsonl", b"{}\n"),
    ("export eds -o x.eds", "x.eds", b"[FileInfo]\n"),
    ("export dbc -o x.dbc", "x.dbc", b'VERSION ""\n'),
    ("export dcf --node-id 5 -o x.dcf", "x.dcf", b"[DeviceInfo]\n"),
    ("export c -o firmware", "firmware/tipforce_od.h", b"/* old */\n"),
    ("design sweep h2 --steps 3 -o x.svg", "x.svg", SVG),
    ("design table 3 --format svg -o figures", "figures/condition-and-noise.svg", SVG),
    ("calibrate budget cal.toml -o x.png", "x.png", PNG),
    ("plot run.log -o x.svg", "x.svg", SVG),
    ("plot run.log -o x.png", "x.png", PNG),
    ("plot run.log -o x.pdf", "x.pdf", b"%PDF old"),
    ("decode run.log -o x.csv", "x.csv", CSV),
    ("decode run.log -o x.jsonl", "x.jsonl", b"{}\n"),
    ("decode run.log -o x.txt", "x.txt", b"node   5 (0x05)\n"),
    ("decode run.log -o x.parquet", "x.parquet", b"PAR1 old"),
    ("decode run.log -o x.mcap", "x.mcap", b"\x89MCAP old"),
    ("run scene.toml -o x.log", "x.log", b"(1.000000) vcan0 123#\n"),
    ("run table.toml", "table.csv", CSV),
    ("run plot.toml", "scene.svg", SVG),
    ("config save 5 settings.toml --all {bus}", "settings.toml", b"[objects]\n"),
    ("config save 5 settings.dcf {bus}", "settings.dcf", b"[FileInfo]\n"),
]


@contextmanager
def full_disk(limit_bytes: int = 64) -> Iterator[None]:
    """No file of this process may become longer: a write fails as on a full disk, with another error number.

    Python before 3.14 keeps the truncated byte code of a module that it imports meanwhile: none may be written."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "dont_write_bytecode", True)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_calibration(folder / "cal.toml", beam_calibration("I", pull=True))
    write_readings(folder / "data.csv", simulate("I", np.random.default_rng(4)))
    (folder / "readings.csv").write_text("SG1,SG2,SG3\n" + 50 * "-125.0,728.7,323.6\n")
    (folder / "run.log").write_text(CONTACTS_LOG)
    for name, outputs in (("scene", ""), ("table", 'table = "table.csv"\n'), ("plot", 'plot = "scene.svg"\n')):
        (folder / f"{name}.toml").write_text(SCENE + outputs)
    return folder


@pytest.mark.parametrize(("command", "name", "old"), WRITES, ids=[f"{c.split()[0]}-{n}" for c, n, _ in WRITES])
def test_a_failed_write_leaves_the_old_file(
    command: str, name: str, old: bytes, inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    printed: Printed, channel: str,
) -> None:  # fmt: skip
    for path in inputs.iterdir():
        (tmp_path / path.name).symlink_to(path)
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_bytes(old)
    monkeypatch.chdir(tmp_path)
    before = files(tmp_path)
    with connected(finger(5), channel=channel), full_disk():
        err = printed(1, command.format(bus=f"-i virtual -c {channel}")).err
    assert files(tmp_path) == before, err
    last = err.splitlines()[-1]
    assert Path(name).name in last or name.split("/", maxsplit=1)[0] in last
    assert "File too large" in last
    assert "Traceback" not in err


def test_a_failed_write_leaves_the_dataset(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Printed
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "other.log").write_text(CONTACTS_LOG.replace("(17", "(18"))
    printed(0, f"decode {inputs}/run.log -q -o parts/")
    before = files(tmp_path)
    with full_disk():
        assert "File too large" in printed(1, "decode other.log -q -o parts/").err
    assert files(tmp_path) == before


def test_a_recording_that_replaces_another_is_kept_beside_it(tmp_path: Path, printed: Printed) -> None:
    path = tmp_path / "run.log"
    path.write_text(CONTACTS_LOG)
    words = f"log -i virtual outputs1 -o {path} --overwrite -q"
    with counting("outputs1"), full_disk(2000):
        assert "File too large; the frames so far are in" in printed(1, words).err
    assert path.read_text() == CONTACTS_LOG
    (beside,) = set(tmp_path.iterdir()) - {path}
    assert beside.stat().st_size == 2000
    with counting("outputs1"):
        printed(0, f"{words} -n 3")
    assert len(path.read_text().splitlines()) == 3


def test_the_file_appears_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "cal.toml"
    with new_file(path) as partial:
        partial.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    with pytest.raises(ZeroDivisionError), new_file(path) as partial:
        partial.write_text(str(1 // 0))
    assert files(tmp_path) == {"cal.toml": b"new"}


def test_links_and_permissions_stay_and_devices_are_written_directly(tmp_path: Path) -> None:
    path, link = tmp_path / "real.toml", tmp_path / "link.toml"
    path.write_bytes(TOML)
    path.chmod(0o640)
    link.symlink_to(path)
    write_file(link, TOML * 2, CALIBRATION)
    assert link.is_symlink()
    assert path.read_bytes() == TOML * 2
    assert path.stat().st_mode & 0o777 == 0o640
    with pytest.raises(WriteError, match="No space left on device"):
        write_file("/dev/full", TOML)
    with pytest.raises(InputError, match="is a directory"):
        NewFile(tmp_path)


CONTROLS = "".join(map(chr, (*range(1, 9), *range(11, 32), *range(127, 160)))) + "\u200f\u202e\u2066\u2028"
HOSTILE = f"A\x1b[31mB\x1b]0;t\x07[bold]C[/] {CONTROLS}\nINJECTED line\r\x9b1mD\tE"
"""Colours, titles, bidi controls, the markup of rich, and a line of its own."""
NAME = "A\x1b[31mB[bold]\x01\x07\x08\r\t\x1c\x7f\x85\x9b\u2028\u202e\u2066 \udcff"  # of a file: 0xFF is no UTF-8
QUOTED = json.dumps(HOSTILE)  # as TOML writes it, too
HIDDEN = re.compile("[^\n\t -~\xa0-\uffff]|[\xad\u200b-\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
COLOURS = re.compile(r"\x1b\[[\d;]*m")

KEY = "A\x1b[31mB[bold]\x01\x07\x08\x7f\x9b\u202e\u2066"  # without what ends a line
MARKUP = "[bold]A[/] [red]B :smile:"
EDS = INFO.replace("Anyone", KEY).replace("=Device", f"={KEY}") + MANDATORY.replace("Vendor\n", f"V{KEY}\n").replace(
    "=2", "=3"
)
EDS += var("1008", 9, "const", "x") + var("2000", 4, "rw", "7").replace("P2000", f"P{KEY}")
EDS += var("1018sub2", 7, "ro", "1") + var("100A", 9, "const", "x")
for place in ("1F56", "1F57"):
    EDS += record(place, var(f"{place}sub0", 5, "const", "1"), var(f"{place}sub1", 7, "ro", "0"))
EDS += var("2002", 9, "rw", KEY).replace("P2002", f"Q{KEY}")
NAMED_LOG = CONTACTS_LOG.replace("vcan0", "".join(one for one in NAME if not one.isspace() and one > " "))
MARKED_SCENE = f"title = {QUOTED}{SCENE.replace('[outputs]', '[[expect]]')}P_error_N = 0.001\n"
FILES = {
    "any.eds": EDS,
    "run.log": NAMED_LOG,
    "comment.log": f"# {NAME}\n" + CONTACTS_LOG + f"{NAME}\n(1700000001.0) {NAME} 123#00\n",
    "noise.asc": NAME,
    "scene.toml": MARKED_SCENE,
    "markup.toml": MARKED_SCENE.replace(QUOTED, json.dumps(MARKUP)),
    "keys.toml": f"[objects]\n{QUOTED} = {QUOTED}\n[{QUOTED}]\nx = {QUOTED}\n",
    "markup_hand.toml": f"[hand]\nsync_hz = 50\n[[finger]]\nname = {json.dumps(MARKUP)}\nnode_id = 5\n",
    "hand.toml": f"[hand]\nsync_hz = 50\n[[finger]]\nname = {QUOTED}\nnode_id = 5\n",
    "two.toml": 2 * f"[[finger]]\nname = {QUOTED}\nnode_id = 5\n",
    "layout.toml": f"points = [{QUOTED}]\n",
    "machine.toml": f'[[device]]\neds = "any.eds"\nnode_id = 5\napplication = {QUOTED}\n',
    "values.toml": f'[[device]]\neds = "any.eds"\nnode_id = 5\nvalues = {{{QUOTED} = {QUOTED}}}\n',
    "readings.csv": f"SG1,SG2,SG3,{KEY}\n1,2,3,{KEY}\n{KEY},1,2,3\n",
    "data.csv": f"SG1,SG2,SG3,P_N,phi_deg,theta_deg\n{KEY},1,2,3,4,5\n",
    NAME: NAME,
    f"{NAME}.log": CONTACTS_LOG,
}
BUS = "-i virtual -c BUS"
NODE = f"{BUS} --timeout 0.2 --retries 1"
CASES: dict[str, list[str]] = {
    "demo": ["demo HOSTILE"],
    "node": ["node --node-id 5 --layout layout.toml " + BUS, "node --node-id 5 --layout NAME " + BUS],
    "run": ["run scene.toml", "run markup.toml --color always", "run keys.toml", "run NAME",
            *(f"run {name} --explain" for name in ("markup.toml", "keys.toml", "NAME"))],
    "simulate": [f"simulate {name} {BUS}" for name in ("machine.toml", "values.toml", "keys.toml", "NAME --node-id 5")],
    "scan": ["scan --wait 0.2 " + NODE, "scan --json --wait 0.2 " + NODE],
    "read": ["read 5 -n 1 " + NODE],
    "sdo": [
        "sdo read 5 0x1008 " + NODE, "sdo read 5 0x1008 --json " + NODE, "sdo dump 5 " + NODE,
        "sdo dump 6 --eds any.eds " + NODE, "sdo read 6 0x2002 --eds any.eds " + NODE, "sdo read 6 HOSTILE " + NODE,
        "sdo write 5 0x1017 HOSTILE " + NODE,
    ],
    "hand": ["hand check hand.toml", "hand check markup_hand.toml", "hand check two.toml",
             "hand run hand.toml --seconds 0.3 " + BUS],
    "nmt": ["nmt start HOSTILE " + BUS],
    "lss": ["lss assign HOSTILE " + BUS],
    "firmware": [f"firmware {words} {NODE}" for words in ("show 5", "show 6", "show 6 --json", "install 5 NAME")],
    "config": [
        "config show 5 --all " + NODE, "config show 6 --eds any.eds " + NODE, "config apply 5 keys.toml " + NODE,
        "config show 5 --all --json " + NODE,
    ],
    "calibrate": [f"calibrate {words}" for words in (
        "fit data.csv", "fit NAME", "verify keys.toml --node 5 " + NODE, "apply NAME --node 5 " + NODE,
        "budget keys.toml", "budget NAME", "budget cal.toml --layout layout.toml")],
    "tare": ["tare HOSTILE " + BUS],
    "estimate": ["estimate cal.toml readings.csv", "estimate keys.toml readings.csv", "estimate cal.toml NAME"],
    "dump": ["dump run.log", "dump comment.log --decode", "dump run.log --json", "dump NAME"],
    "decode": [
        "decode run.log", "decode run.log lines.pcapng", "decode run.log lines.pcapng --format jsonl",
        "decode run.log lines.pcapng --summary", "decode comment.log --strict", "decode noise.asc", "decode NAME.log",
        "decode --eds 5=any.eds run.log", "decode NAME",
    ],
    "dataset": ["dataset show data", "dataset show data --json", "dataset show NAME", "dataset sql data SELECT",
                "dataset sql data --json SELECT"],
    "log": ["log -o none/NAME " + BUS],
    "replay": ["replay NAME " + BUS],
    "plot": ["plot run.log --bus HOSTILE -o x.svg", "plot NAME -o x.svg", "plot noise.asc -o x.svg"],
    "monitor": ["monitor run.log", "monitor lines.pcapng run.log", "monitor lines.pcapng --eds 5=any.eds",
                "monitor NAME"],
    "view": ["view NAME", "view keys.toml", "view noise.asc"],
    "ros2": ["ros2 two.toml", "ros2 NAME"],
    "design": ["design sweep HOSTILE", "design sweep h2 --layout layout.toml", "design HOSTILE"],
    "report": ["report HOSTILE"],
    "conformance": ["conformance --node-id 6 --case HOSTILE " + BUS],
    "export": ["export eds --eds NAME", "export dcf --node-id 5 --settings keys.toml",
               "export ros2 --hand two.toml -o o"],
    "doctor": ["doctor --listen HOSTILE"],
    "vcan": ["vcan --HOSTILE", "--completion HOSTILE"],
}  # fmt: skip


def test_every_command_has_a_case() -> None:
    assert set(CASES) == set(COMMANDS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The hostile files, and a dataset of hostile logs."""
    found = tmp_path_factory.mktemp("hostile")
    for name, text in FILES.items():
        (found / name).write_bytes(text.encode("utf-8", "surrogateescape"))
    channel = f"{KEY}\nINJECTED".encode()
    start = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1), "<")
    start += block(1, struct.pack("<HHIHH", 227, 0, 0, 2, len(channel)) + channel + bytes(-len(channel) % 4 + 4), "<")
    packets = [socketcan(0x285, bytes.fromhex(f"2E1129239A1103{k:02X}")) for k in range(50)]
    frames = (block(6, struct.pack("<IIIII", 0, 0, k, len(one), len(one)) + one, "<") for k, one in enumerate(packets))
    (found / "lines.pcapng").write_bytes(start + b"".join(frames))
    write_calibration(found / "cal.toml", beam_calibration("I", pull=True))
    logs = [str(found / name) for name in ("run.log", "lines.pcapng", f"{NAME}.log")]
    exit_code(["decode", *logs, "-q", "-o", f"{found}/data/"])
    return found


def hostile_devices(folder: Path) -> Iterator[Device]:
    """A fingertip, 5, and a device of an EDS, 6: the content of each text is hostile."""
    for device in (finger(5), device_of(read_eds(folder / "any.eds", 6))):
        od = device.od
        for index, subs in od._entries.items():
            for sub, (kind, access, flags, _, low, high) in subs.items():
                if kind in ("s", "D"):
                    od.add(index, sub, (kind, access, flags, HOSTILE.encode() if kind == "D" else HOSTILE, low, high))
        yield device


LINES = [line for lines in CASES.values() for line in lines] + [f"{name} --HOSTILE" for name in COMMANDS]
SELECT = "select *, chr(27) || chr(10) || 'INJECTED' as x from samples limit 2"


@pytest.mark.parametrize("line", LINES)
def test_output_has_no_control_characters(
    line: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], channel: str
) -> None:
    monkeypatch.chdir(folder)
    words = {"BUS": channel, "SELECT": SELECT}
    with connected(*(hostile_devices(folder) if "BUS" in line else ()), channel=channel):
        exit_code([words.get(w, w).replace("NAME", NAME).replace("HOSTILE", HOSTILE) for w in line.split()])
    out, err = capsys.readouterr()
    assert out + err
    shown = COLOURS.sub("", out) if "--color always" in line else out
    assert HIDDEN.findall(shown + err) == []
    assert not re.search(r"^INJECTED", shown + err, re.MULTILINE), shown + err
    assert "Traceback" not in err
    if "markup" in line and "explain" not in line:
        assert MARKUP in out
    if "--json" in line or "jsonl" in line:
        for record in out.splitlines():
            json.loads(record)
