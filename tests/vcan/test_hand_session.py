"""A hand of five nodes on a real bus: killed nodes, an interface that goes down; and nothing old is live.

How long a hand takes to be correct again is counted in heartbeats of a finger that nothing happened to, 200 ms each: 10
of them are the 2 s that are promised. The wall-clock figure is only printed, because tests assert none: it is that of a
processor which is emulated, and shared with whatever else a machine does. Heartbeats are sent by a process on that same
processor, so while it stands still they do, and where nodes wait for their turn so does this clock."""

import time
from collections.abc import Iterator
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import numpy as np
import pytest

from host.bus_with_nodes import beam_calibration
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.hand.events import Event
from tipforce.host.hand.hand import Hand
from tipforce.samples.record import Rows
from vcan.pressed import NEWTONS_PER_S, force_newtons, run_node
from vcan.support import HEARTBEAT, SDO_REQUEST, Launch, RawBus, ip_link, is_boot_up, wait_until
from vcan.support import _context as context

CHANNEL = "vcan1"
NODE_IDS = (1, 2, 3, 4, 5)
SYNC_HZ = 25
# A hand file that says nothing of it has 100 ms, and an emulated processor of which nobody else wants a share carries
# that, too. Where others do, all nodes stand still together for more than the 250 ms after which they would be lost.
HEARTBEAT_MS = 200
# What a busy machine may cause: a heartbeat that is late, a response that is late or comes to the next request (the
# recovery is repeated), and a node that had to wait and then answers at once all SYNCs that it missed.
LATE = (
    "heartbeat_lost", "heartbeat_back", "started: was silent", "failed: no response", "failed: no valid response",
    "babbling: 0x28", "babbling_end: 0x28",
)  # fmt: skip
# A read after a boot takes 3 ms on an emulated processor, and 25 ms on one of four that want the machine. So reads are
# counted, and the time is that of an overloaded machine. The simulated hand (tests/host/hand/test_another_master.py)
# counts in time that does not hang on the processor.
RECOVERED_MS = 30_000
RECOVERY_REQUESTS = 300  # 218 where none is repeated
NOT_OF_THIS_SYNC_NEWTONS = 0.5 * NEWTONS_PER_S / SYNC_HZ  # an answer to the SYNC before is off by twice as much


class Session:
    """Five node processes, the hand, and every row and event that it gave."""

    def __init__(self, folder: Path) -> None:
        self.nodes: dict[int, ForkServerProcess] = {}
        self.rows: list[Rows] = []
        for node_id in NODE_IDS:
            self.switch_on(node_id)
        write_calibration(folder / "cal.toml", beam_calibration())
        fingers = "".join(
            f'[[finger]]\nnode_id = {n}\nserial = {1000 + n}\ncalibration = "cal.toml"\n' for n in NODE_IDS
        )
        self.path = folder / "hand.toml"
        self.path.write_text(
            f'[bus]\ninterface = "socketcan"\nchannel = "{CHANNEL}"\n'
            f'[hand]\nsync_hz = {SYNC_HZ}\nheartbeat_ms = {HEARTBEAT_MS}\nforeign_changes = "restore"\n{fingers}'
        )
        self.hand = Hand.from_file(self.path)
        self.hand.on_rows(self.rows.append)

    def switch_on(self, node_id: int) -> None:
        """Power: no store, so it knows its node-id and nothing else. Returns when it has booted."""
        with RawBus(CHANNEL) as bus:
            self.nodes[node_id] = context.Process(target=run_node, args=(node_id, CHANNEL), daemon=True)
            self.nodes[node_id].start()
            bus.until(is_boot_up(node_id))

    def switch_off(self, node_id: int) -> None:
        process = self.nodes.pop(node_id)
        process.kill()
        process.join()

    def close(self) -> None:
        self.hand.close()
        for node_id in list(self.nodes):
            self.switch_off(node_id)

    def latest(self) -> np.ndarray:
        """P (5,) of the last row; NaN before there is one."""
        return self.rows[-1].columns["P"][-1] if self.rows else np.full(len(NODE_IDS), np.nan)

    def whole(self) -> bool:
        """All fingers are there: in the last row, and by their heartbeats."""
        return self.hand.settled() and not np.isnan(self.latest()).any()

    def recovered(self, what: str, node_id: int = 1) -> None:
        """Wait until the hand is correct again, in rows from now on: RECOVERED_MS and RECOVERY_REQUESTS at most."""
        begin_s, begin_ns = time.monotonic(), time.time_ns()
        with RawBus(CHANNEL, HEARTBEAT + NODE_IDS[0]) as bus, RawBus(CHANNEL, SDO_REQUEST + node_id) as sdo:
            wait_until(lambda: self.whole() and self.rows[-1].sync_ns[-1] > begin_ns, what)
            took_s, beats, requests = time.monotonic() - begin_s, len(bus.waiting()), len(sdo.waiting())
        print(f"{what}: after {beats} heartbeats of {HEARTBEAT_MS} ms, {requests} SDO requests, {took_s:.2f} s")
        assert beats * HEARTBEAT_MS <= RECOVERED_MS, what
        assert requests <= RECOVERY_REQUESTS, what

    def checked(self) -> int:
        """Every value of every row so far, against what its finger felt at the SYNC of the row: how many there were."""
        count = 0
        for block in list(self.rows):
            for k, node_id in enumerate(NODE_IDS):
                P = block.columns["P"][:, k]
                known = ~np.isnan(P)
                error_newtons = (P - force_newtons(block.sync_ns, node_id))[known]
                assert (np.abs(error_newtons) < NOT_OF_THIS_SYNC_NEWTONS).all(), (node_id, error_newtons)
                assert not (known & block.missing[:, k]).any()
                count += int(known.sum())
        return count

    def kinds(self) -> list[tuple[str, int]]:
        """What happened since the last call."""
        return [(named(event), event.node_id) for event in self.hand.events()]


def named(event: Event) -> str:
    """The kind of an event; with its reason where that is in LATE, and of a failure always."""
    reasons = [late for late in LATE if late.startswith(f"{event.kind}: ") and late.split(": ")[1] in event.text]
    return reasons[0] if reasons else f"failed: {event.text}" if event.kind == "failed" else event.kind


def of_others(kinds: list[tuple[str, int]], node_id: int = -1) -> list[tuple[str, int]]:
    """The events of other fingers than this one, without those of a busy machine."""
    return [(kind, of) for kind, of in kinds if of != node_id and kind not in LATE]


def setting_up(kinds: list[tuple[str, int]], node_id: int) -> list[str]:
    """The steps by which a finger was set up, in order; a step that was repeated, because a response was late, once."""
    steps = [kind for kind, of in kinds if of == node_id and kind in ("boot_up", "calibrated", "started")]
    return list(dict.fromkeys(steps))


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    """A hand that is up and runs."""
    found = Session(tmp_path_factory.mktemp("hand"))
    try:
        begun_s = time.monotonic()
        for _ in range(3):  # where a response takes over 0.5 s, a finger fails, and is brought up again
            reports = found.hand.bring_up()
            if all(report.ok for report in reports):
                break
        assert [str(report) for report in reports] == [f"finger {n}: up" for n in NODE_IDS]
        print(f"bring-up: {time.monotonic() - begun_s:.2f} s")
        found.hand.start()
        found.recovered("start")
        yield found
    finally:
        found.close()


@pytest.fixture(autouse=True)
def nothing_old(session: Session) -> Iterator[None]:
    """Around every test: a whole hand, and afterwards no value in any row that is not of its SYNC."""
    for node_id in set(NODE_IDS) - set(session.nodes):  # of a test that failed
        session.switch_on(node_id)
    wait_until(session.whole, "the hand should be whole")
    session.kinds()
    session.rows.clear()
    yield
    assert session.checked() > 0


def test_started_hand_has_no_mending_to_do(session: Session) -> None:
    wait_until(lambda: len(session.rows) > 10, "rows should come")
    assert of_others(session.kinds()) == []
    statistics = session.hand.statistics()
    assert statistics.tally.mixed.sum() == 0
    assert statistics.dropped == 0
    assert statistics.sync.mean_period_us > 0.5e6 / SYNC_HZ  # one producer, not two


def test_killed_node_is_unknown_and_comes_back(session: Session) -> None:
    session.switch_off(2)
    killed_ns = time.time_ns()
    wait_until(lambda: session.hand.state(2) == "silent", "its heartbeat should be missed")
    wait_until(lambda: np.isnan(session.latest()).tolist() == [n == 2 for n in NODE_IDS], "it alone should be missing")
    kinds = session.kinds()
    assert ("heartbeat_lost", 2) in kinds
    assert of_others(kinds, 2) == []
    for block in list(session.rows):
        assert np.isnan(block.columns["P"][block.sync_ns > killed_ns, 1]).all()
    session.switch_on(2)
    session.recovered("killed node", 2)
    kinds = session.kinds()
    assert setting_up(kinds, 2) == ["boot_up", "calibrated", "started"]
    assert of_others(kinds, 2) == []


def test_interface_down_and_up(session: Session) -> None:
    ip_link("set", CHANNEL, "down")
    try:
        down: list[tuple[str, int]] = []
        wait_until(lambda: ("bus_down", 0) in down, "it should be noticed", lambda: down.extend(session.kinds()))
        assert of_others(down) == [("bus_down", 0)]
        assert not session.hand.settled()
        assert {session.hand.state(n) for n in NODE_IDS} == {"silent"}
        rows = len(session.rows)
        time.sleep(0.3)
        assert len(session.rows) <= rows + 1  # the one that was open
    finally:
        ip_link("set", CHANNEL, "up")
    session.recovered("interface down and up")
    kinds = session.kinds()
    assert {("heartbeat_back", n) for n in NODE_IDS} <= set(kinds)
    assert of_others(kinds) == [("bus_up", 0)]  # they were never away: nothing to set up


def test_hand_up_by_command(session: Session, launch: Launch) -> None:
    """On a hand that runs already: everything is as the file says."""
    for _ in range(3):  # as in the fixture: a response may take over 0.5 s
        command = launch("hand", "up", str(session.path))
        if command.wait() == 0:
            break
    assert command.wait() == 0, command.stderr
    assert command.stdout.splitlines() == [f"finger {n}: up" for n in NODE_IDS]
    session.recovered("hand up beside us")
    kinds = [one for one in session.kinds() if one[0] not in LATE]
    # Stopped by the command and started by either; nothing was set up again.
    assert set(kinds) <= {(kind, n) for n in NODE_IDS for kind in ("state", "started")}
