"""The faulty bus: each fault as often as asked, the same for a seed; bits on the wire, and the budget of a hand."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_device.can_frame import least_bits, most_bits
from host.bus_with_nodes import new_channel
from tipforce.errors import InputError
from tipforce.host.frames.frame_array import frame_array
from tipforce.host.network import faulty_bus
from tipforce.host.network.bus_load import LoadMeter, hand_budget, highest_rate_hz, range_of_bits, what_fits
from tipforce.host.network.faulty_bus import Babbler, Faults, FaultyBus, Injector, RawFrame, quiet
from tools.rig import Clock

FRAMES: list[RawFrame] = [(0x181 + k % 5, k.to_bytes(4, "little")) for k in range(4000)]


def through(faults: Faults, seed: int = 1, frames: list[RawFrame] = FRAMES) -> tuple[list[RawFrame], Injector]:
    """What comes out of an injector, a frame each millisecond."""
    injector, found = Injector(faults, seed), []
    for k, frame in enumerate(frames):
        injector.put(frame, k * 1e-3)
        while (taken := injector.take(k * 1e-3)) is not None:
            found.append(taken)
    while (taken := injector.take(1e9)) is not None:
        found.append(taken)
    return found, injector


@pytest.mark.parametrize("name", ["drop", "duplicate", "corrupt", "reorder", "delay"])
def test_each_fault_strikes_as_often_as_asked(name: str) -> None:
    found, injector = through(replace(Faults(), **{name: 0.1}))  # type: ignore[arg-type]
    count = injector.counts[name]
    assert 300 < count < 500
    assert set(injector.counts) == {name}
    lost, invented = Counter(FRAMES) - Counter(found), Counter(found) - Counter(FRAMES)
    expected = {"drop": (count, 0), "duplicate": (0, count), "corrupt": (count, count)}.get(name, (0, 0))
    assert (lost.total(), invented.total()) == pytest.approx(expected, abs=1)
    if name in ("reorder", "delay"):
        assert found != FRAMES
    if name == "corrupt":
        pairs = [(a, b) for a, b in zip(FRAMES, found, strict=True) if a != b]
        flipped = [int.from_bytes(a[1], "little") ^ int.from_bytes(b[1], "little") for a, b in pairs]
        assert {value.bit_count() for value in flipped} == {1}


def test_the_same_seed_is_the_same_run() -> None:
    faults = Faults(0.1, 0.1, 0.1, 0.1, 0.1)
    assert through(faults)[0] == through(faults)[0] != through(faults, seed=2)[0]
    assert through(Faults())[0] == FRAMES
    # One fault more leaves the others where they strike.
    dropped = Counter(FRAMES) - Counter(through(Faults(drop=0.1))[0])
    assert not Counter(through(Faults(drop=0.1, duplicate=0.1))[0]).keys() & dropped.keys()


@given(st.floats(0, 1), st.floats(0, 1), st.integers(0, 99))
def test_only_the_named_identifiers(drop: float, delay: float, seed: int) -> None:
    found, _ = through(Faults(drop=drop, delay=delay, only=frozenset({0x182})), seed, FRAMES[:200])
    others = [frame for frame in FRAMES[:200] if frame[0] != 0x182]
    assert [frame for frame in found if frame[0] != 0x182] == others


@pytest.fixture
def buses() -> Iterator[tuple[can.BusABC, FaultyBus]]:
    channel = new_channel()
    with can.Bus(interface="virtual", channel=channel) as sender:
        faulty = FaultyBus(can.Bus(interface="virtual", channel=channel), Faults(), seed=3)
        with faulty:
            yield sender, faulty


def received(bus: can.BusABC, timeout_s: float = 0.02) -> list[bytes]:
    found = []
    while (message := bus.recv(timeout_s)) is not None:
        found.append(bytes(message.data))
    return found


def test_a_bus_behind_it(buses: tuple[can.BusABC, FaultyBus]) -> None:
    sender, faulty = buses
    faulty.faults = Faults(drop=0.5, delay=0.5, delay_s=0.01)
    for k in range(100):
        sender.send(can.Message(arbitration_id=0x181, data=[k], is_extended_id=False))
    found: list[bytes] = []
    while len(found) < 100 - faulty.counts["drop"]:
        delayed = faulty.recv(10.0)
        assert delayed is not None
        found.append(bytes(delayed.data))
    assert received(faulty) == []
    assert len(found) == len(set(found))
    assert found != sorted(found)
    faulty.faults = quiet(faulty.faults)
    sender.send(can.Message(arbitration_id=0x12345678, data=[7], is_remote_frame=False, is_extended_id=True))
    message = faulty.recv(1.0)
    assert message is not None
    assert (message.arbitration_id, message.is_extended_id, bytes(message.data)) == (0x12345678, True, b"\x07")


def test_what_is_due_when_a_late_wait_ends_is_received(monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread is woken after the due time and the deadline; a delay counts from the arrival."""
    clock, frames = Clock(), iter([can.Message(arbitration_id=1)])

    def recv(timeout_s: float) -> can.Message | None:
        clock.sleep(timeout_s + 1.0)
        return next(frames, None)

    monkeypatch.setattr(faulty_bus, "time", SimpleNamespace(monotonic=clock, time_ns=lambda: 0))
    inner = Mock(channel_info="", protocol=can.CanProtocol.CAN_20, recv=recv)
    with FaultyBus(inner, Faults(delay=1.0, delay_s=50.0), seed=3) as bus:
        begin_s = clock.now_s
        assert bus._recv_internal(5.0) == (None, False)
        due_s = bus.next_due_s()
        assert due_s is not None
        assert due_s >= begin_s + 6.0
        assert due_s > clock.now_s
        assert bus._recv_internal(due_s - clock.now_s + 0.5)[0] is not None


def test_bus_off_and_on(buses: tuple[can.BusABC, FaultyBus]) -> None:
    sender, faulty = buses
    faulty.bus_off = True
    sender.send(can.Message(arbitration_id=0x181, data=[1], is_extended_id=False))
    with pytest.raises(can.CanOperationError, match="bus-off"):
        faulty.recv(0.01)
    with pytest.raises(can.CanOperationError, match="bus-off"):
        faulty.send(can.Message(arbitration_id=1))
    faulty.bus_off = False
    sender.send(can.Message(arbitration_id=0x181, data=[2], is_extended_id=False))
    assert received(faulty) == [b"\x02"]
    faulty.send(can.Message(arbitration_id=0x100, data=[9], is_extended_id=False))
    assert received(sender) == [b"\x09"]


def test_a_babbler_keeps_its_rate() -> None:
    babbler = Babbler((0x185, bytes(8)), 1000.0)
    assert len(babbler.step(0.0)) == 1
    assert sum(len(babbler.step(k * 0.01)) for k in range(1, 101)) == pytest.approx(1000, abs=2)
    assert len(babbler.step(100.0)) <= 102


@pytest.mark.parametrize("wrong", [{"drop": 1.1}, {"delay": -0.1}, {"delay_s": -1.0}, {"corrupt": float("nan")}])
def test_what_is_no_probability_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        Faults(**wrong)  # type: ignore[arg-type]
    with pytest.raises(InputError):
        Babbler((0, b""), 0.0)


# --- bits on the wire, and the budget of a hand --------------------------------------------------------------------

identifiers = st.one_of(
    st.integers(0, 0x7FF),
    st.integers(0, 0x7FF).map(lambda n: n | 0x40000000),
    st.integers(0, 0x1FFFFFFF).map(lambda n: n | 0x80000000),
    st.integers(0, 0x1FFFFFFF).map(lambda n: n | 0xC0000000),
)


def test_the_figures_of_the_standard() -> None:
    assert [least_bits(8), most_bits(8), least_bits(0), most_bits(0)] == [111, 135, 47, 55]
    assert [least_bits(8, True), most_bits(8, True)] == [131, 160]


def test_five_fingers_at_a_kilohertz() -> None:
    both = hand_budget(5, 1000, ("Gauges", "Contact"))
    assert both.least_load == pytest.approx(1.16, abs=0.005)
    assert both.most_load == pytest.approx(1.405, abs=0.005)
    one = hand_budget(5, 1000, ("Contact",))
    assert 0.60 < one.least_load < one.most_load < 0.735
    assert hand_budget(15, 243, ("Gauges", "Contact")).most_load == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize(("nodes", "pdos"), [(5, ("Contact",)), (15, ("Gauges", "Contact", "Health"))])
def test_the_highest_rate_is_where_the_limit_is(nodes: int, pdos: tuple[str, ...]) -> None:
    rate = highest_rate_hz(nodes, pdos, limit=0.5)
    assert hand_budget(nodes, rate, pdos).most_load == pytest.approx(0.5)
    assert highest_rate_hz(127, ("Health",), bit_rate=10_000) == 0.0


def test_what_fits_has_the_health_pdo_and_the_heartbeats_of_the_hand() -> None:
    (line,), others = what_fits(2, 100.0, ("Contact",), 3, 1_000_000, 0.05), most_bits(8) / 0.3 + most_bits(1) / 0.05
    rate = (0.8e6 - 2 * others) / (most_bits(0) + 2 * most_bits(8))
    most = (0.8e6 - 100 * most_bits(0)) // (100 * most_bits(8) + others)
    assert line.endswith(f"2 nodes up to {rate:.0f} Hz; at 100 Hz up to {most:.0f} nodes")


@pytest.mark.parametrize(
    "arguments", [(0, 1.0), (128, 1.0), (1, 0.0), (1, -1.0), (1, float("nan")), (1, 1.0, ("Torque",)), (1, 1.0, ())]
)
def test_refused(arguments: tuple[int, float]) -> None:
    with pytest.raises(InputError):
        hand_budget(*arguments)


@given(st.lists(st.tuples(identifiers, st.binary(max_size=8)), max_size=20))
def test_the_fast_range_is_that_of_each_frame(frames: list[tuple[int, bytes]]) -> None:
    frames = [*frames, (0x20000004, bytes(8))]  # an error frame is not what was on the wire
    array = frame_array([(k, can_id, data) for k, (can_id, data) in enumerate(frames)])
    least, most = range_of_bits(array)
    real = [(0 if i & 0x40000000 else len(data), bool(i & 0x80000000)) for i, data in frames if not i & 0x20000000]
    assert (least, most) == (sum(least_bits(*one) for one in real), sum(most_bits(*one) for one in real))


def test_the_meter_looks_at_the_last_second() -> None:
    meter = LoadMeter(100_000)
    frames = frame_array([(0, 0x181, bytes(8))] * 100)
    assert meter.load(0.0) == (0.0, 0.0)
    for k in range(5):
        meter.add(frames, 0.3 * k)
    meter.add(frames[:0], 1.3)
    low, high = meter.load(1.2)
    assert low == pytest.approx(4 * 100 * 111 / 100_000)
    assert high == pytest.approx(4 * 100 * 135 / 100_000)
    assert meter.load(9.0) == (0.0, 0.0)
