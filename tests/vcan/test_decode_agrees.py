"""One candump log, decoded by `tipforce dump --decode` and by cantools with our DBC: the same values."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from tipforce.dictionary import objects as od
from tipforce.dictionary.signals import tpdo_messages
from tipforce.host.network.bus import Bus
from tipforce.host.network.finger import FingertipClient
from tipforce.host.network.sdo import SdoChannel
from tipforce.sensor.structure.published import GROOVES_DEG
from tipforce_tools.demo.job import case_calibration
from vcan.support import NODE_ID, REPOSITORY, SYNC, WAIT_S, Command, RawBus, peer, tipforce, wait_until

DBC = REPOSITORY / "dbc" / "tipforce.dbc"
MARKER = 0x7FE  # an identifier that is no message of the DBC
SYNCS_PER_STATE = 15
NONE, STUCK, OPEN, SATURATED, SILENT = range(5)  # 2200h:1
_CANTOOLS = re.compile(
    r"\([\d.]+\) vcan0 (?P<id>[0-9A-F]+)#\S* :: (?:(?P<name>\w+)\((?P<signals>.*)\)|Unknown frame.*)"
)

Values = dict[str, float | None]


class Decoded(NamedTuple):
    """What a decoder made of one line of the log: message "" where it knows none; None is unknown."""

    can_id: int
    message: str
    values: Values


@pytest.fixture(scope="module")
def log(node: Command, host: Bus, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few hundred SYNCs of a node that is uncalibrated, loaded, unloaded and faulty, recorded by candump."""
    path = tmp_path_factory.mktemp("log") / "run.log"
    sdo = host.sdo(NODE_ID)
    with RawBus() as bus, peer("candump", "-r", "4000000", "-L", "vcan0", output=path):
        wait_until(lambda: "7FE#" in path.read_text(), "candump is silent", lambda: bus.send(MARKER))
        sdo.write(od.TPDO3_COB_ID, 0x40000380 + NODE_ID)
        sdo.write(od.TPDO4_COB_ID, 0x40000480 + NODE_ID)
        sdo.write(od.TPDO4_EVENT_TIMER_MS, 20)
        host.nmt("start", NODE_ID)
        _syncs(bus)
        FingertipClient(sdo).apply_calibration(case_calibration("I", pull=True))
        for phi, theta in GROOVES_DEG:
            _load(sdo, 4.4, phi, theta)
            _syncs(bus)
        for fault in (OPEN, SATURATED, SILENT, NONE):
            sdo.write(od.SIMULATION_FAULT, fault)
            _syncs(bus)
        _load(sdo, 0.0, 0.0, 0.0)
        _syncs(bus)
        bus.send(MARKER, b"end")
        wait_until(lambda: "7FE#656E64" in path.read_text(), f"candump lags\n{node.stderr}")
    return path


def _load(sdo: SdoChannel, *load: float) -> None:
    for entry, value in zip((od.SIMULATION_P, od.SIMULATION_PHI, od.SIMULATION_THETA), load, strict=True):
        sdo.write(entry, value)


def _syncs(bus: RawBus) -> None:
    """SYNCs, each when the node has answered the one before (TPDO3 is its last answer), then one event-driven TPDO4."""
    for _ in range(SYNCS_PER_STATE):
        bus.send(SYNC)
        bus.until(lambda frame: frame[0] == 0x380 + NODE_ID)
    bus.until(lambda frame: frame[0] == 0x480 + NODE_ID)


def by_dump(path: Path) -> Iterator[Decoded]:
    with path.open("rb") as file:
        words = tipforce("dump", "--decode", "--json", "-")
        done = subprocess.run(words, stdin=file, capture_output=True, text=True, timeout=WAIT_S, check=True)
    assert done.stderr == ""
    flags = {m.name: [s.name for s in m.signals if s.bits == 1] for m in tpdo_messages()}
    for line in done.stdout.splitlines():
        record = json.loads(line)
        name = record.get("message", "")
        values: Values = dict(record.get("values", {}))
        values |= {flag: float(flag in record["status"]) for flag in flags.get(name, [])}
        if "counter" in record:
            values["counter"] = record["counter"]
        yield Decoded(int(record["id"], 16), f"TIP{record['node']:02d}_{name}" if name else "", values)


def by_cantools(path: Path) -> Iterator[Decoded]:
    with path.open("rb") as file:
        words = [sys.executable, "-m", "cantools", "decode", "--single-line", str(DBC)]
        done = subprocess.run(words, stdin=file, capture_output=True, text=True, timeout=WAIT_S, check=True)
    for line in done.stdout.splitlines():
        match = _CANTOOLS.fullmatch(line)
        assert match is not None, line
        values: Values = {}
        pdo = re.fullmatch(r"TIP\d\d_(Gauges|Contact|Force|Health)", match["name"] or "")
        for part in match["signals"].split(", ") if pdo else ():
            name, _, value = part.partition(": ")
            values[name] = None if value == "unknown" else float(value.split()[0])
        yield Decoded(int(match["id"], 16), match["name"] if pdo else "", values)


def test_dump_and_cantools_agree_on_every_signal_of_every_message(log: Path) -> None:
    lines = log.read_text().splitlines()
    ours, theirs = list(by_dump(log)), list(by_cantools(log))
    assert len(lines) == len(ours) == len(theirs)
    scales = {f"TIP{NODE_ID:02d}_{m.name}": {s.name: s.scale for s in m.signals} for m in tpdo_messages()}
    unknown: dict[str, int] = {}
    known: dict[str, int] = {}
    for line, our, their in zip(lines, ours, theirs, strict=True):
        assert our[:2] == their[:2], line
        assert our.values.keys() == their.values.keys() == scales.get(our.message, {}).keys(), line
        for name, scale in scales.get(our.message, {}).items():
            a, b = our.values[name], their.values[name]
            assert (a is None) == (b is None), (line, name)
            counts = unknown if a is None else known
            counts[name] = counts.get(name, 0) + 1
            if a is not None and b is not None:
                assert round(a / scale) == round(b / scale), (line, name, a, b)
    messages = Counter(our.message for our in ours)
    states = 1 + len(GROOVES_DEG) + 5
    pdos = {name: messages[f"TIP05_{name}"] for name in ("Gauges", "Contact", "Force")}
    assert pdos == dict.fromkeys(pdos, states * SYNCS_PER_STATE)
    assert messages["TIP05_Health"] >= states
    # Every measurement was seen with a value and without one.
    for name in ("SG1", "SG2", "SG3", "P", "phi", "theta", "F1", "F2", "F3"):
        assert min(unknown.get(name, 0), known.get(name, 0)) >= SYNCS_PER_STATE, (name, unknown, known)
    for name in ("u_P", "temperature"):
        assert min(unknown.get(name, 0), known.get(name, 0)) >= 2, (name, unknown, known)


def test_decoded_lines_come_while_candump_still_runs(bus: RawBus, node: Command, tmp_path: Path) -> None:
    output = tmp_path / "decoded"
    bus.send(0x000, bytes((1, NODE_ID)))
    with output.open("wb") as file:
        candump = subprocess.Popen(["candump", "-L", "vcan0"], stdout=subprocess.PIPE)
        dump = subprocess.Popen(tipforce("dump", "--decode", "-"), stdin=candump.stdout, stdout=file)
        try:
            wait_until(lambda: "Contact" in output.read_text(), "no decoded line", lambda: bus.send(SYNC))
            assert candump.poll() is None
            assert f"node {NODE_ID} (0x{NODE_ID:02X}) Contact" in output.read_text(), node.stderr
        finally:
            candump.terminate()
            candump.wait(WAIT_S)
            if candump.stdout is not None:
                candump.stdout.close()
            try:
                code = dump.wait(WAIT_S)
            finally:
                dump.kill()
        assert code == 0, "the end of its input is the end of its work"
