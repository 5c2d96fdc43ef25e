"""Wrong inputs: one line that names the place and the next step, and the documented exit code."""

from __future__ import annotations

from pathlib import Path

import pytest

from host.bus_with_nodes import connected, finger, new_channel
from tipforce.host.configuration.calibration_file import write_calibration
from tipforce.scene import beam_calibration
from tipforce_tools.cli.main import main

LOG = "".join(f"({1700000000 + k / 1000:.6f}) vcan0 285#2E1129239A1103{k:02X}\n" for k in range(50))
EXTENDED = "".join(f"(1700000000.{k:06d}) can0 18FEF1{k:02X}#0102030405060708\n" for k in range(40))
FILES = {
    "run.log": LOG,
    "j1939.log": EXTENDED,
    "other.log": EXTENDED.replace("18FEF1", "3"),
    "prose.txt": "these are no frames\n",
    "broken.blf": "XXXX" + 200 * "x",
    "noise.asc": "\x01\x02\x03",
    "bad.toml": "[hand\n",
    "empty.toml": "",
    "hand.toml": '[[finger]]\nnode_id = 1\ncalibration = "none.toml"\n',
    "one.toml": "[[finger]]\nnode_id = 1\n",
    "taken/bus.yml": "routes: 12\n",
    "twice.toml": "[[finger]]\nnode_id = 1\n[[finger]]\nnode_id = 1\n",
    "scene.toml": "duration_s = -1\n",
    "readings.csv": "SG1,SG2,SG3\n1,2,3\n",
    "two.csv": "SG1,SG2\n1,2\n",
    "si.csv": "SG1,SG2,SG3,P_N,phi_deg,theta_deg\n",
    "objects.toml": '[objects]\n"heartbeat.producer_sm" = 1\n',
    "layout.toml": 'points = ["K_H", "S_H"]\n',
    "empty.dcf": "",
}
NOBODY = "-i virtual -c nobody --timeout 0.01 --retries 0"

WRONG: list[tuple[str, int, str]] = [
    # usage
    ("dumb", 2, "did you mean dump"),
    ("decode --from yesterday run.log", 2, "allowed are seconds from the start"),
    ("decode --gauges 9 run.log", 2, "--gauges"),
    ("decode --signals Q run.log", 2, "no message has the signal Q: allowed are"),
    ("decode --jobs 0 run.log", 2, "--jobs 0: allowed is 1 or more"),
    ("decode --resample -5 run.log", 2, "--resample"),
    ("decode --resample 1e9 run.log", 2, "choose a lower rate"),
    ("decode --dcf empty.dcf run.log", 2, "no [section] in it"),
    ("decode run.log -o out.xyz", 2, "unknown suffix: allowed are"),
    ("decode run.log --format parquet", 2, "needs --output FILE"),
    ("decode none.log", 2, "none.log: no such file"),
    ("decode none/*.log", 2, "no file matches"),
    ("decode . ", 2, "is a directory; name its logs"),
    ("decode - run.log", 2, "stdin cannot be decoded together with files"),
    ("decode --calibration none.toml run.log", 2, "none.toml: No such file"),
    ("decode --dbc none.dbc run.log", 2, "none.dbc"),
    ("dump any,18G:7FF run.log", 2, "filter '18G:7FF'"),
    ("dump none.log", 2, "none.log: no such file"),
    ("dump -L -e run.log", 2, "leave one out"),
    ("dump -n 0 run.log", 2, "allowed are whole numbers from 1"),
    ("plot run.log", 2, "add -o FILE.png"),
    ("plot run.log -o x.doc", 2, "allowed are the suffixes"),
    ("plot run.log -o none/x.svg", 2, "create it first"),
    ("replay none.log -i virtual -c x", 2, "none.log"),
    ("sdo read 300 0x1017 -i virtual", 2, "node-id '300': allowed are 1 to 127"),
    (f"sdo read 5 heartbeat.producer {NOBODY}", 2, "close to it: heartbeat.producer_ms"),
    (f"sdo read 5 0x1018 {NOBODY}", 2, "has several sub-indices"),
    (f"sdo read 5 0x1018:09 {NOBODY}", 2, "no sub-index 9"),
    ("sdo write 5 heartbeat.producer_ms 70000 -i virtual -c x", 2, "allowed are 0 to 65535"),
    ("nmt start 5-1 -i virtual", 2, "the second is smaller"),
    ("nmt begin 5 -i virtual", 2, "invalid choice: 'begin'"),
    ("tare 5 --clear --show -i virtual", 2, "not allowed with argument"),
    ("scan -i nonsense", 2, "invalid choice: 'nonsense'"),
    ("scan --wait -1 -i virtual -c x", 2, "--wait -1: allowed is 0 s or more"),
    ("read 5 -n x -i virtual", 2, "allowed are whole numbers from 1"),
    ("config show 5 x.toml -i virtual", 2, "takes no FILE"),
    (f"config apply 5 objects.toml {NOBODY}", 2, "close to it: heartbeat.producer_ms"),
    ("hand run none.toml", 2, "none.toml"),
    ("hand run bad.toml", 2, "bad.toml"),
    ("hand check twice.toml", 2, "node_id"),
    ("hand check hand.toml", 2, "none.toml"),
    ("hand run hand.toml --seconds 0", 2, "--seconds 0: allowed is a time over 0"),
    ("run none.toml", 2, "none.toml"),
    ("run scene.toml", 2, "duration_s"),
    ("run empty.toml", 2, "empty.toml"),
    ("calibrate fit none.csv", 2, "none.csv: No such file"),
    ("calibrate fit prose.txt", 2, "prose.txt"),
    ("calibrate fit si.csv", 2, "si.csv"),
    ("calibrate verify hand.toml --node 5 -i virtual -c x", 2, "hand.toml"),
    ("estimate hand.toml readings.csv", 2, "hand.toml"),
    ("estimate cal.toml two.csv", 2, "allowed are SG1 to SGn without a gap, n = 3 to 8"),
    ("estimate cal.toml readings.csv -o readings.csv", 2, "is also an input; choose another name"),
    ("estimate cal.toml none.csv", 2, "none.csv: No such file"),
    ("budget cal.toml --phi 10", 2, "one load needs both"),
    ("design sweep q", 2, "allowed are"),
    ("design sweep h2 --layout layout.toml", 2, "layout"),
    ("export dcf", 2, "add it, for example --node-id 5"),
    ("export c", 2, "name a folder"),
    ("export eds --gauges 2", 2, "allowed 3 to 8"),
    ("load --nodes 5 --bitrate 0", 2, "allowed are whole numbers from 1, in bit/s"),
    ("log -o none/x.log -i virtual -c x", 2, "the directory none does not exist; create it first"),
    ("report -o run.log", 2, "is a file; name a directory"),
    ("load --nodes 0", 2, "allowed are whole numbers from 1"),
    ("view none.log", 2, "none.log"),
    ("view run.log --from 100", 2, "no sample between --from and --to; the log lasts 0.049 s"),
    ("view run.log --from nan", 2, "--from nan: allowed is 0 to 1e+09 s"),
    ("view run.log --port 70000", 2, "--port 70000: allowed are 0"),
    ("doctor --listen -1", 2, "allowed are 0 to 3600 s"),
    ("node --node-id 5 --layout nowhere -i virtual -c x", 2, "neither one of"),
    ("node --node-id 5 --source spi:0 -i virtual -c x", 2, "sim, iio"),
    ("node --node-id 5 --load 1,2 -i virtual -c x", 2, "--load"),
    ("node --node-id 5 --load 1e300,0,0 -i virtual -c x", 2, "allowed is a force up to 1e+09 N"),
    ("node --node-id 5 --offset 1e300,1,1 -i virtual -c x", 2, "allowed is up to 1e+06 microstrain"),
    ("node --node-id 5 --serial -1 -i virtual -c x", 2, "'-1': allowed are 0 to 0xFFFFFFFF"),
    ("design optimise --seed -1", 2, "allowed are whole numbers from 0"),
    ("budget --load 1e300", 2, "--load 1e+300: allowed is 1e-09 to 1e+09 N"),
    ("budget --noise 1e300", 2, "--noise 1e+300: allowed is 0 to 1e+09"),
    ("export c -o run.log", 2, "is a file; name a directory"),
    ("export ros2 --hand one.toml -o taken", 2, "the existing file is not a bus.yml of ros2_canopen"),
    # damaged logs, and logs of other devices
    ("decode prose.txt", 1, "no frames in it; is it a log?"),
    ("decode broken.blf", 1, "the file is damaged or of another format"),
    ("decode noise.asc", 1, "noise.asc"),
    ("decode j1939.log", 1, "all have 29-bit identifiers, which CANopen does not use"),
    ("decode other.log -o x.csv", 1, "`tipforce dump --decode` shows what they are"),
    ("plot j1939.log -o x.svg", 1, "all have 29-bit identifiers"),
    ("monitor j1939.log", 1, "all have 29-bit identifiers"),
    ("view broken.blf", 1, "the file is damaged or of another format"),
    ("dump prose.txt", 1, "other formats: `tipforce decode`"),
    # buses and nodes
    ("scan -i socketcan -c nowhere9", 2, "check -i and -c"),
    (f"sdo read 5 0x1017 {NOBODY}", 5, "`tipforce scan` lists nodes"),
    (f"tare 5 {NOBODY}", 5, "check its power, bus, bit rate and node-id"),
    (f"calibrate apply cal.toml --node 5 --yes {NOBODY}", 5, "`tipforce scan` lists nodes"),
    ("sdo read 5 0x3000 0 u8 BUS", 11, "object does not exist"),
    ("sdo write 5 0x1000 1 BUS", 11, "read-only"),
    ("tare 5 BUS", 11, "the node is not calibrated: `tipforce calibrate apply CAL.toml --node 5` first"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("wrong")
    for name, text in FILES.items():
        (found / name).parent.mkdir(exist_ok=True)
        (found / name).write_text(text)
    write_calibration(found / "cal.toml", beam_calibration("I", pull=True))
    return found


def test_there_are_sixty() -> None:
    assert len(WRONG) >= 60
    assert {code for _, code, _ in WRONG} == {1, 2, 5, 11}


@pytest.mark.parametrize(("command", "code", "text"), WRONG, ids=[command for command, _, _ in WRONG])
def test_one_line_the_next_step_and_the_exit_code(
    command: str,
    code: int,
    text: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    before = sorted(path.name for path in folder.iterdir())
    channel = new_channel()
    if command.endswith(" BUS"):
        with connected(finger(5), channel=channel):
            found = called(command.removesuffix("BUS") + f"-i virtual -c {channel}")
    else:
        found = called(command)
    out, err = capsys.readouterr()
    assert found == code, err
    assert out == ""
    assert text in err
    assert len(err.splitlines()) <= (2 if code == 1 else 1), err  # of a log also its first bad line
    assert sorted(path.name for path in folder.iterdir()) == before


def called(command: str) -> int:
    """The exit code of a command in this process."""
    try:
        return main(command.split())
    except SystemExit as ended:  # argparse
        return int(ended.code or 0)
