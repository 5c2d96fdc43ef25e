"""Datasets whose files, manifest or logs are not as they should be: equal rows, or one line with the next step."""

import gzip
import os
import random
import signal
from pathlib import Path

import pytest

from tipforce.errors import InputError
from tipforce.host.dataset import manifest as manifests
from tipforce.host.dataset.manifest import DataFile, Part
from tipforce.host.dataset.reader import opened
from tipforce.host.dataset.store import FOLDER, Store, generations, is_dataset
from tipforce.host.decoding.sample_table import Column
from tipforce_tools.cli.main import main
from tipforce_tools.decode import dataset_run, session
from tools.decode.logs import decode, globbed, log_lines, rows_of_dataset, rows_of_logs, write_log
from tools.rig import Printed


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """And a manifest that holds everything once per so many commits as there are parts."""
    monkeypatch.setattr(session, "_DATASET_PIECE_BYTES", 30_000)
    monkeypatch.setattr(manifests, "_PARTS_PER_CHANGE", 1)


@pytest.fixture(scope="module")
def lines() -> list[str]:
    return log_lines(500, (1, 5), health=100)


@pytest.fixture
def days(tmp_path: Path, lines: list[str]) -> list[Path]:
    """A log in three, cut within samples."""
    cuts = [0, 603, 1501, len(lines)]
    return [write_log(tmp_path / f"day-{k}.log", lines[cuts[k] : cuts[k + 1]]) for k in range(3)]


def check(data: Path, *logs: Path, apart: bool = False) -> None:
    """Compare the rows with those of one decode, of each log if they were added apart; no other file is there."""
    parts = [(log,) for log in logs] if apart else [logs]
    assert rows_of_dataset(data) == sorted(row for part in parts for row in rows_of_logs(*part))
    assert main(["dataset", "verify", f"{data}"]) == 0
    assert globbed(data) == {file.path for file in opened(str(data))[1].files()}


def test_removed_and_truncated_files_are_written_again(tmp_path: Path, days: list[Path], printed: Printed) -> None:
    data = tmp_path / "data"
    assert decode(*days, "-j", 1, "-o", f"{data}/") == 0
    manifest = opened(str(data))[1]
    of_second = [part for part in manifest.parts if part.source == manifest.sources[1].id]
    (data / of_second[0].files[0].path).unlink()
    os.truncate(data / of_second[-1].files[-1].path, 50)
    for words in (["dataset", "sql", f"{data}", "select 1"], ["decode", "-q", f"{data}"]):
        (line,) = printed(1, words).err.splitlines()
        assert "missing or damaged" in line
        assert "writes them again" in line
    assert main(["dataset", "show", f"{data}"]) == 1  # sizes show it, too
    assert decode(days[1], "-j", 1, "-o", f"{data}/") == 0
    check(data, *days)


@pytest.mark.parametrize("command", ["decode", "dataset"])
def test_killed_before_replaced_files_are_removed(tmp_path: Path, lines: list[str], command: str) -> None:
    log, data = write_log(tmp_path / "run.log", lines[:1500]), tmp_path / "data"
    assert decode(log, "-j", 1, "-o", f"{data}/") == 0
    write_log(log, lines)
    child = os.fork()
    if not child:
        removed = manifests.remove_replaced

        def killed(store: Store, manifest: manifests.Manifest) -> None:
            if manifest.replaced:
                os.kill(os.getpid(), signal.SIGKILL)
            removed(store, manifest)

        manifests.remove_replaced = killed
        words = ["-q", str(log), "-j", "1", "-o", f"{data}/"] if command == "decode" else ["compact", str(data), "-q"]
        os._exit(main([command, *words]))
    assert os.waitpid(child, 0)[1] == signal.SIGKILL
    assert len(globbed(data)) > len(list(opened(str(data))[1].files()))
    assert decode(log, "-j", 1, "-o", f"{data}/") == 0
    check(data, log)


def test_compaction_beside_another_writer(tmp_path: Path, lines: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    from tipforce_tools.writing import dataset_files

    log, data = write_log(tmp_path / "run.log", lines[:1500]), tmp_path / "data"
    assert decode(log, "-j", 1, "-o", f"{data}/") == 0
    write_log(log, lines)
    committed = manifests.commit

    def meanwhile(*words: object) -> None:
        def commit(store: Store, change: manifests.Change) -> manifests.Manifest:
            monkeypatch.undo()
            assert main([*map(str, words)]) == 0
            return committed(store, change)

        monkeypatch.setattr(dataset_files, "commit", commit)

    meanwhile("decode", "-q", log, "-j", 1, "-o", f"{data}/")
    assert main(["dataset", "compact", str(data), "-q"]) == 0  # both are done
    check(data, log)
    assert decode(log, "-j", 1, "-o", f"{data}/") == 0
    write_log(log, [*lines, *(line.replace("(170000", "(170001") for line in lines)])
    monkeypatch.setattr(session, "_DATASET_PIECE_BYTES", 30_000)
    assert decode(log, "-j", 1, "-o", f"{data}/") == 0
    meanwhile("dataset", "compact", data, "-q")
    assert main(["dataset", "compact", str(data), "-q"]) == 1  # the same parts: one of them
    check(data, log)


@pytest.fixture
def hours(tmp_path: Path, lines: list[str]) -> list[Path]:
    """Five logs of a day, each with the boot-up of a node, which were added one by one and compacted."""
    found = []
    for hour in range(5):
        moved = [line.replace("(1700000", f"({1_700_000 + hour}") for line in lines]
        moved.insert(1, moved[0].replace("080#", "705#00"))
        found.append(write_log(tmp_path / f"hour-{hour}.log", moved[: 200 * (hour + 1)]))
        assert decode(found[-1], "-j", 1, "-o", f"{tmp_path}/data/") == 0
    assert len(globbed(tmp_path / "data")) > 10
    assert main(["dataset", "compact", f"{tmp_path}/data", "-q"]) == 0
    return found


def test_logs_of_a_day_are_compacted(tmp_path: Path, hours: list[Path], lines: list[str]) -> None:
    data = tmp_path / "data"
    check(data, *hours, apart=True)
    assert len(globbed(data)) == 4  # of each node one, and the last part of the last log
    assert len(list((data / "events").iterdir())) == 1
    before = opened(str(data))[1].generation
    assert main(["dataset", "compact", f"{data}", "-q"]) == 0
    assert opened(str(data))[1].generation == before
    for hour in (0, 3, 4):  # a log that grows leaves the files that it shares
        moved = [line.replace("(1700000", f"({1_700_000 + hour}") for line in lines]
        with hours[hour].open("a") as log:
            log.write("".join(line + "\n" for line in moved[200 * (hour + 1) - 1 : 200 * (hour + 1) + 200]))
        assert decode(*hours[hour : hour + 1], "-j", 1, "-o", f"{data}/") == 0
        check(data, *hours, apart=True)
    assert main(["dataset", "compact", f"{data}", "-q"]) == 0
    check(data, *hours, apart=True)
    assert len(globbed(data)) == 4


def test_a_file_of_several_logs_is_repaired_log_by_log(tmp_path: Path, hours: list[Path]) -> None:
    data = tmp_path / "data"
    shared = max(opened(str(data))[1].files(), key=lambda file: file.rows)
    (data / shared.path).unlink()
    for hour, log in enumerate(hours):
        assert main(["dataset", "show", f"{data}"]) == 1
        assert decode(log, "-j", 1, "-o", f"{data}/") == 0
        listed = {file.path for file in opened(str(data))[1].files()}
        assert globbed(data) == listed - ({shared.path} if hour < 4 else set())
    check(data, *hours, apart=True)


def test_logs_that_are_not_logs(tmp_path: Path, lines: list[str]) -> None:
    data = tmp_path / "data"
    junk = tmp_path / "junk.log"
    junk.write_bytes(bytes(range(256)) * 40)
    syncs = write_log(tmp_path / "syncs.log", [line for line in lines if "080#" in line])
    for log in (junk, syncs, junk, syncs):  # the second time is no success either
        assert decode(log, "-j", 1, "-o", f"{data}/") == 1
    assert not is_dataset(data)
    empty, log = write_log(tmp_path / "empty.log", []), write_log(tmp_path / "run.log", lines)
    for logs in ((empty,), (empty, log), (log, empty)):  # every log begins like an empty one
        assert decode(*logs, "-j", 1, "-o", f"{data}/") == 0
    check(data, log)


def test_copies_and_other_states_of_a_log(tmp_path: Path, lines: list[str], days: list[Path], printed: Printed) -> None:
    log, copy = write_log(tmp_path / "run.log", lines), write_log(tmp_path / "copy.log", lines)
    start, data = write_log(tmp_path / "start.log", lines[:1000]), tmp_path / "data"
    for pair in ((log, copy), (start, log), (log, log)):
        assert "begins like" in printed(2, ["decode", *pair, "-j", 1, "-o", f"{data}/"]).err
    for logs in ((start,), (log,), (log, copy)):
        assert decode(*logs, "-j", 1, "-o", f"{data}/") == 0
    check(data, log)
    packed = tmp_path / "run.log.gz"
    packed.write_bytes(gzip.compress(log.read_bytes()))
    changed = write_log(tmp_path / "changed.log", [*lines[:900], *lines[1000:]])
    for other in (packed, changed):
        assert "begins like" in printed(2, f"decode {other} -j 1 -o {data}/").err
    moved = tmp_path / "moved"
    moved.mkdir()
    other_data = tmp_path / "days"
    assert decode(days[0], "-j", 1, "-o", f"{other_data}/") == 0
    first = days[0].rename(moved / "first.log")
    assert decode(first, *days[1:], "-j", 1, "-o", f"{other_data}/") == 0
    check(other_data, log)


def test_interrupted_between_two_logs(tmp_path: Path, days: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """The first log alone completes its own rows; all logs complete the rest."""
    monkeypatch.setattr(dataset_run, "_COMMIT_S", 0.0)
    for parts in (1, 3):  # of the first log there is one
        data = tmp_path / f"data-{parts}"
        committed: list[int] = []

        def commit(store: Store, change: manifests.Change, parts: int = parts, done: list[int] = committed) -> object:
            if len(done) == parts:
                raise KeyboardInterrupt
            done.append(1)
            return manifests.commit(store, change)

        monkeypatch.setattr(dataset_run, "commit", commit)
        assert decode(*days, "-j", 1, "-o", f"{data}/") == 130
        monkeypatch.setattr(dataset_run, "commit", manifests.commit)
        assert decode(days[0], "-j", 1, "-o", f"{data}/") == 0
        if parts == 1:
            check(data, days[0])
        assert decode(*days, "-j", 1, "-o", f"{data}/") == 0
        check(data, *days)


@pytest.mark.parametrize(
    ("text", "says"),
    [('{"format": 2, "parts": 5}', "newer one"), ('{"format": 1, "gener', "put back a copy"), ("", "put back a copy")],
)
def test_manifests(tmp_path: Path, days: list[Path], printed: Printed, text: str, says: str) -> None:
    data = tmp_path / "data"
    (data / FOLDER).mkdir(parents=True)
    (data / FOLDER / "manifest-0000000004.json").write_text(text)
    for words in (f"dataset show {data}", f"decode {days[0]} -o {data}/"):
        (line,) = printed(2, words).err.splitlines()
        assert says in line


def test_changes_of_a_manifest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two writers in turns: what is read is what was committed, in few files, most of them without what stays."""
    monkeypatch.setattr(manifests, "_PARTS_PER_CHANGE", 10)
    store, order = Store(str(tmp_path)), random.Random(25)
    parts: dict[str, Part] = {}
    seen = [manifests.Manifest(), manifests.Manifest()]
    sizes = []
    for number in range(150):
        gone = order.sample(sorted(parts), min(len(parts), order.choice([0, 0, 1])))
        files = [DataFile(f"events/{'a' * 12}-{n:014d}-1-{'b' * 12}.parquet", 1, 1, 1, "", n, n) for n in [number] * 3]
        added = Part(f"part {number}", "a" * 12, number, number + 1, 1, {"cut": number}, files)
        parts = {name: part for name, part in parts.items() if name not in gone} | {added.id: added}
        column = Column(f"V{number % 50}_ustrain", "V", "real", 3, "", number)
        writer = order.randrange(2)
        change = manifests.Change({}, set(gone), [added], [column], seen[writer])
        seen[writer] = manifests.commit(store, change)
        found = manifests.read_manifest(store)
        assert found == seen[writer]
        assert found.generation == number + 1
        assert found.parts == list(parts.values())
        assert len(found.columns) == min(number + 1, 50)
        assert set(found.replaced) == {f"events/{'a' * 12}-{int(name[5:]):014d}-1-{'b' * 12}.parquet" for name in gone}
        sizes.append((tmp_path / FOLDER / generations(store)[-1]).stat().st_size)
        assert len(generations(store)) <= len(parts) // 10 + 3
    assert sorted(sizes)[len(sizes) // 2] < 2000 < max(sizes) / 10
    (tmp_path / FOLDER / generations(store)[0]).unlink()
    with pytest.raises(InputError, match="a file of it is missing"):
        manifests.read_manifest(store)


def test_inputs_and_outputs_that_cannot_be(tmp_path: Path, days: list[Path], printed: Printed) -> None:
    data = tmp_path / "data"
    assert decode(days[0], "-j", 1, "-o", f"file://{data}/") == 0
    for words, says in (
        ([data, "-o", f"{tmp_path}/other/"], "name the logs"),
        ([days[1], "-o", f"{data}/", "--format", "csv"], "has Parquet files"),
        ([days[1], "-o", "nothing://data/"], "not a URL that fsspec opens"),
    ):
        assert says in printed(2, ["decode", *words]).err
    assert decode(data, days[1], "-j", 2, "-o", tmp_path / "both.csv") == 0


def test_without_hard_links(tmp_path: Path, days: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(_source: object, _target: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)
    for count in (1, 3):
        assert decode(*days[:count], "-j", 1, "-o", f"{tmp_path}/data/") == 0
    check(tmp_path / "data", *days)
