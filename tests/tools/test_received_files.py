"""Files from elsewhere reach nothing outside their folder; files that commands of 9931bb3 wrote keep working."""

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import tipforce
from canopen_device.machine.file import read_machine
from canopen_device.running.store import FileStore
from canopen_device.testing import Conversation
from eds.samples import described, text, var
from host.bus_with_nodes import finger
from tipforce.dictionary import objects as od
from tipforce.errors import EnvironmentLackError, InputError
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.hand.file import read_hand
from tipforce.host.network.interfaces import open_bus
from tipforce.scene import beam_calibration
from tools.decode.logs import decode, log_lines, write_log
from tools.rig import Printed, exit_code

MARK = "5EC4E7"
"""Stands in every file outside; no output may have it."""
OUTSIDE = {
    ".toml": f"{MARK} = 1\n", ".json": json.dumps({"application": MARK}), ".csv": f"t_s,{MARK}\n0,1\n",
    ".log": f"(1.000000) can0 123#{MARK}\n", ".png": "", ".eds": f"[FileInfo]\nFileName={MARK}\n[{MARK}]\n",
    ".py": f"print({MARK!r})\n", ".parquet": MARK,
}  # fmt: skip
NAMES = [
    "../x", "/etc/passwd", "{outside}/x", "a/../../x", "a/../../received/../x", "link", "folder/x", "..\\x",
    "a\\..\\..\\x", "C:\\x", "nul\0x", "line\nx", "", ".", "..", "a/..", "~", "~/x", "long" + "x" * 300, 500 * "long/",
]  # fmt: skip
"""Names in files; with the suffix of their kind where they end in x or link."""


@pytest.fixture
def received(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of the files, which is the working directory; what is around it stays as it is."""
    outside = tmp_path / "outside"
    inside = outside / "received"
    inside.mkdir(parents=True)
    (outside / "keep.txt").write_text(MARK)
    for suffix, content in OUTSIDE.items():
        (outside / f"x{suffix}").write_text(content)
        (inside / f"link{suffix}").symlink_to(outside / f"x{suffix}")
    (inside / "folder").symlink_to(outside)
    (inside / "a").mkdir()
    monkeypatch.chdir(inside)
    monkeypatch.setenv("HOME", str(outside))
    before = tree(tmp_path, inside)
    yield inside
    assert tree(tmp_path, inside) == before


def tree(root: Path, left_out: Path) -> dict[str, bytes]:
    """The content of every file below a folder, without one folder; or of one file."""
    found: dict[str, bytes] = {"": root.read_bytes()} if root.is_file() else {}
    for place, folders, files in os.walk(root):
        folders[:] = [name for name in folders if Path(place, name) != left_out]
        found |= {str(Path(place, name)): b"" for name in folders}
        found |= {str(Path(place, name)): Path(place, name).read_bytes() for name in files}
    return found


def named(name: str, suffix: str, folder: Path) -> str:
    """Return one of NAMES with a suffix."""
    return name.format(outside=folder.parent) + (suffix if name.endswith(("x", "link")) else "")


FINGER = "[[finger]]\nnode_id = 1\n"
SCENE = 'duration_s = 0.02\nsync_hz = 100\n[[nodes]]\nids = [1]\npdos = ["contact"]\n'
DEVICE = '[[device]]\nnode_id = 5\neds = "own.eds"\n'
KINDS = {
    "hand: calibration": (".toml", f"{FINGER}calibration = NAME\n"),
    "hand: config": (".toml", f"[hand]\nconfig = NAME\n{FINGER}"),
    "hand: config of a finger": (".toml", f"{FINGER}config = NAME\n"),
    "scene: calibration": (".toml", f"{SCENE}calibration = NAME\n"),
    "scene: log": (".log", f"{SCENE}[outputs]\nlog = NAME\n"),
    "scene: table": (".csv", f"{SCENE}[outputs]\ntable = NAME\n"),
    "scene: plot": (".png", f"{SCENE}[outputs]\nplot = NAME\n"),
    "machine: eds": (".eds", DEVICE.replace('"own.eds"', "NAME")),
    "machine: store": (".json", f"{DEVICE}store = NAME\n"),
    "machine: application": (".py", f"{DEVICE}application = NAME\n"),
    "machine: signal": (
        ".csv", f'{DEVICE}[[device.signal]]\nkind = "csv"\nobject = "P2000"\ncolumn = "P"\nfile = NAME\n'
    ),
}  # fmt: skip
"""By the place of a NAME: its suffix, and the file."""


def use_file(folder: Path, kind: str, name: str) -> None:
    """Write a file of a kind that names another, and read it. Raises InputError."""
    (folder / "own.eds").write_text(text(var("2000", 5)))
    told = f"{name}:Press" if kind == "machine: application" else name
    (folder / "x.toml").write_text(KINDS[kind][1].replace("NAME", json.dumps(told)))
    if kind.startswith("machine"):
        read_machine("x.toml")
    elif code := exit_code("run x.toml" if kind.startswith("scene") else "hand check x.toml"):
        raise InputError(f"exit {code}")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", KINDS)
def test_a_file_names_no_other_outside_its_folder(
    received: Path, kind: str, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    if name or not kind.startswith(("hand", "machine: store", "machine: application")):  # there "" is none
        with pytest.raises(InputError) as refused:
            use_file(received, kind, named(name, KINDS[kind][0], received))
        told = capfd.readouterr()
        lines = (told.err or f"{refused.value}\n").splitlines()
        assert len(lines) == 1
        if name:
            assert re.search("allowed is a path below|a link leads out of|one line without", lines[0])
        assert MARK not in told.out + told.err + str(refused.value)


@pytest.mark.parametrize("name", ["own", "./own", "a/own", "a/./own", "to-own"])
def test_names_and_links_in_the_folder_are_followed(received: Path, name: str) -> None:
    for place in (received / "own.toml", received / "a" / "own.toml"):
        write_calibration(place, beam_calibration("I"))
    (received / "to-own.toml").symlink_to("a/own.toml")
    (received / "hand.toml").write_text(f'[[finger]]\nnode_id = 1\ncalibration = "{name}.toml"\n')
    found = read_hand("hand.toml")
    assert found.calibration(found.finger[0]) is not None
    (received / "scene.toml").write_text(f'{SCENE}calibration = "{name}.toml"\n')
    assert exit_code("run scene.toml -q") == 0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("key", ["UploadFile", "DownloadFile"])
def test_a_dcf_serves_no_file_outside_its_folder(received: Path, key: str, name: str) -> None:
    found = described(received, text(var("2001", 15, "rw", "", **{key: named(name, ".toml", received)})))
    assert MARK not in repr([(entry.value, entry.default) for entry in found.entries()])
    assert MARK not in "".join(found.warnings)


@pytest.mark.parametrize("name", NAMES)
def test_interfaces_of_a_log_name_no_file(received: Path, name: str) -> None:
    name = named(name, ".log", received).replace("\0", "").replace("\n", "") or "x"
    log = write_log(received / "run.log", [line.replace("vcan0", name) for line in log_lines(20, (1,))])
    for output in ("x.csv", "x.mcap", "x.parquet", "data/"):
        decode(log, "-o", output)
    decode("x.mcap", "-o", "mcap/")
    for line in ("dataset compact data -q", "dataset compact mcap -q", f"replay {log} -i virtual --speed inf"):
        exit_code(line)


def test_a_channel_that_writes_a_file_is_refused(received: Path) -> None:
    (received / "hand.toml").write_text('[bus]\ninterface = "usb2can"\ndll = "x.dll"\n[[finger]]\nnode_id = 1\n')
    with pytest.raises(InputError, match="dll"):
        read_hand("hand.toml")
    for channel in ("spy:///dev/null?file=../keep.txt", "SPY:///dev/null?file=../keep.txt"):
        with pytest.raises((InputError, EnvironmentLackError), match="writes a file"):
            open_bus(interface="slcan", channel=channel)


def test_links_with_temporary_names_are_not_followed(received: Path) -> None:
    for name in (f".x.log.{os.getpid()}.part", "node.json.new", "node.json.2"):
        (received / name).unlink(missing_ok=True)
        (received / name).symlink_to(received.parent / "keep.txt")
    store = FileStore("node.json")
    for _ in range(3):
        store.save("group", b"1")
    use_file(received, "scene: log", "x.log")
    assert (received / "x.log").stat().st_size
    (received / "own.eds").write_text(text(var("2000", 5)))
    (received / "machine.toml").write_text('[[device]]\neds = "own.eds"\nnode_id = 5\nstore = "other.json"\n')
    (received / "other.json.2").symlink_to(received.parent / "x.json")
    with pytest.raises(InputError, match=r"other\.json\.2.*a link leads out"):
        read_machine("machine.toml")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with an event in two parts, and its dataset."""
    folder = tmp_path_factory.mktemp("dataset")
    lines = log_lines(60, (1,))
    lines.insert(1, lines[0].replace("080#", "701#00"))
    for share in (0.5, 1.0):
        log = write_log(folder / "run.log", lines[: int(share * len(lines))])
        assert decode(log, "-j", 1, "-o", f"{folder}/data/") == 0
    assert decode(write_log(folder / "b.log", lines[40:]), "-j", 1, "-o", f"{folder}/data/") == 0
    return folder


@pytest.fixture
def data(received: Path, dataset: Path) -> Path:
    """A copy of the dataset in the received folder, beside its log."""
    shutil.copy(dataset / "run.log", received / "run.log")
    return Path(shutil.copytree(dataset / "data", received / "data"))


def use(data: Path, capfd: pytest.CaptureFixture[str]) -> set[int]:
    """Run every command on a dataset; return the exit codes."""
    log = data.parent / "run.log"
    codes = {exit_code(f"dataset {action} {data}") for action in ("show", "verify", "compact")}
    codes.add(exit_code(["dataset", "sql", data, "select * from samples, events"]))
    codes |= {decode(data, "-o", "x.csv"), decode(log, "-j", 1, "-o", f"{data}/")}
    with log.open("a") as stream:
        stream.write("".join(line.replace("(170000", "(170001") + "\n" for line in log_lines(20, (1,))))
    codes |= {decode(log, "-j", 1, "-o", f"{data}/"), exit_code(f"dataset compact {data}")}
    told = capfd.readouterr()
    assert MARK not in told.out + told.err
    assert "Traceback" not in told.err
    return codes


FIELDS: dict[str, Callable[[dict[str, Any], str], None]] = {
    "replaced": lambda manifest, name: manifest.update(replaced=[name]),
    "path of rows": lambda manifest, name: manifest["parts"][0]["files"][0].__setitem__(0, name),
    "path of events": lambda manifest, name: manifest["parts"][0]["events"].__setitem__(0, name),
    "id of a log": lambda manifest, name: manifest["sources"][0].update(id=name),
    "log of a part": lambda manifest, name: manifest["parts"][0].update(source=name),
    "id of a part": lambda manifest, name: manifest["parts"][0].update(id=name),
    "name of a log": lambda manifest, name: manifest["sources"][0].update(name=name),
    "name of a column": lambda manifest, name: manifest["columns"][0].update(name=name),
}
NOT_PATHS = ("id of a part", "name of a log", "name of a column")


@pytest.mark.parametrize("field", FIELDS)
def test_a_manifest_names_no_file_outside(
    received: Path, dataset: Path, data: Path, field: str, capfd: pytest.CaptureFixture[str]
) -> None:
    own = "rows/hand=x/date=2026-05-17/node=1/"
    hostile = [*NAMES, "../keep.txt", own + "../../../../../keep.txt", own + "link.parquet", "_tipforce", "a/x", "*"]
    for name in hostile[:3] if field in NOT_PATHS else hostile:
        shutil.rmtree(data)
        shutil.copytree(dataset / "data", data)
        shutil.copy(dataset / "run.log", received / "run.log")
        file = max((data / "_tipforce").glob("manifest-*.json"))
        manifest = json.loads(file.read_text())
        FIELDS[field](manifest, named(name, ".parquet", received))
        file.write_text(json.dumps(manifest))
        if field in NOT_PATHS:
            assert use(data, capfd) <= {0, 1, 2}
            continue
        before = tree(received, received.parent)
        del before[str(received / "run.log")]  # which use() continues
        assert exit_code("dataset show data") == 2
        [line] = capfd.readouterr().err.splitlines()
        assert "data/_tipforce/manifest-" in line
        assert "of a dataset, at `$." in line
        assert use(data, capfd) == {2}
        after = tree(received, received.parent)
        assert {path: after.get(path) for path in before} == before


@pytest.mark.parametrize(
    "place",
    ["", "rows", "rows/hand=vcan0", "rows/hand=vcan0/*", "rows/*/*/node=1", "rows/*/*/*/*", "events", "events/*",
     "_tipforce", "_tipforce/manifest-*"],
)  # fmt: skip
def test_links_in_a_dataset_are_refused(
    received: Path, data: Path, place: str, capfd: pytest.CaptureFixture[str]
) -> None:
    """A dataset that is a link itself was named by the user; below it none is followed, be it in the dataset or not."""
    elsewhere = received.parent / "elsewhere"
    path = max(data.glob(place)) if place else data
    shutil.move(path, elsewhere)
    path.symlink_to(elsewhere)
    if not place:
        assert use(data, capfd) == {0}
        shutil.rmtree(elsewhere)
        return
    before = tree(elsewhere, received)
    codes = use(data, capfd)  # what does not need the file may succeed
    assert 2 in codes
    assert codes <= {0, 2}
    assert tree(elsewhere, received) == before
    shutil.rmtree(elsewhere) if elsewhere.is_dir() else elsewhere.unlink()


@pytest.mark.parametrize("mark", ["...run", "*.run", "..run", "[0-9a-f].run", "link.run", "0123456789ab.run"])
def test_marks_of_runs_remove_nothing_but_what_a_run_wrote(
    received: Path, data: Path, mark: str, capfd: pytest.CaptureFixture[str]
) -> None:
    kept = [data / "rows/hand=vcan0/own-x.parquet", data / "rows/hand=vcan0/date=2023-11-14/node=1/own-*.parquet"]
    for path in kept:
        path.write_text("kept")
    folder = data / "_tipforce" / mark.removesuffix(".run")
    if not folder.exists():
        folder.symlink_to(received.parent)
    if mark.startswith("link"):
        (data / "_tipforce" / mark).symlink_to(received.parent / "keep.txt")
    else:
        (data / "_tipforce" / mark).touch()
    assert decode(received / "run.log", "-j", 1, "-o", f"{data}/") == 0
    assert all(path.read_text() == "kept" for path in kept)
    assert exit_code(f"dataset verify {data}") == 0
    capfd.readouterr()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the files, in which commands run."""
    shutil.copytree(Path(__file__).with_name("earlier"), tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("line", "code", "said"),
    [
        ("hand check hand.toml", 0, "thumb"),
        ("run scene.toml -q", 0, "PASS: 3 of 3 expectations hold"),
        ("estimate cal.toml session.csv -q", 0, "4,4.39951343,0.0246814928,59.9829389"),
        ("calibrate budget cal.toml", 0, "total                       0.03429"),
        ("calibrate fit session.csv --layout I -o new.toml --date 2026-01-02 -q", 0, "7290.433 +- 1.6e+02"),
        ("decode run.log --calibration cal.toml --summary", 0, "50 samples"),
        ("dataset show data", 2, "an earlier tipforce wrote this dataset"),
        ("decode run.log -o data/", 2, "`tipforce decode LOGS -o NEW/` writes its logs again"),
    ],
)
def test_a_command_takes_them(line: str, code: int, said: str, printed: Printed) -> None:
    assert said in "".join(printed(code, line))


@pytest.mark.usefixtures("folder")
def test_an_mcap_is_its_log(printed: Printed) -> None:
    texts = []
    for name in ("run.log", "run.mcap"):
        printed(0, f"decode {name} -q -o out.csv")
        texts.append(Path("out.csv").read_text())
    assert texts[0] == texts[1]
    assert printed(0, "decode run.mcap --summary --json -q").records[0]["samples"] == 50


def test_a_node_and_a_machine_start_with_their_stores(folder: Path) -> None:
    talk = Conversation(finger(5, store=folder / "node-5.json"))
    assert talk.upload(0x1017) == (250).to_bytes(2, "little")
    assert not any(can_id == 0x85 for can_id, _ in talk.sent)
    lamp, other, drive = read_machine(folder / "machine.toml")
    lamp.step(0)
    assert (lamp[0x2001], other.node_id, drive.node_id) == (290, 8, 9)


@pytest.mark.usefixtures("folder")
def test_settings_are_applied_to_a_node(printed: Printed) -> None:
    with tipforce.simulated_hand([5], interface="virtual", channel="earlier") as bus:
        for words in ("config apply 5 kept.toml -y", "config verify 5 kept.toml",
                      "calibrate apply cal.toml --node 5 -y", "calibrate verify cal.toml --node 5"):  # fmt: skip
            assert "Traceback" not in printed(0, f"{words} -i virtual -c earlier").err
        assert bus.finger(5).sdo.read(od.HEARTBEAT_PRODUCER_MS) == 250
