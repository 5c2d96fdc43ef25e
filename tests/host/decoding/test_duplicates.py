"""Two nodes with one node-id, found by what they send; one node on a faulty bus, never."""

import random
import struct
from collections.abc import Iterable, Iterator, Sequence

import pytest

from canopen_device.core.node import Device
from tipforce.fingertip.node import fingertip_node
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.decoding.duplicates import DuplicateNodes
from tipforce.host.decoding.service_frames import add_samples, find_duplicates
from tipforce.host.frames.frame_array import frame_array
from tipforce.host.network.faulty_bus import Faults, Injector
from tipforce.sensor.structure.strain import FABRICATED, strain_matrix
from tipforce.sources.simulated import SimulatedSource

Frame = tuple[int, int, bytes]  # ns, can_id, data
READ_SERIAL = bytes((0x40, 0x18, 0x10, 4, 0, 0, 0, 0))
PLACES = ((0x1018, 4), (0x1000, 0), (0x6130, 1), (0x1017, 0), (0x9999, 0), (0x1008, 0))
"""Of the reads: constants, a live value, an abort, a segmented transfer."""
BAD_BUSES = {
    "good": Faults(),
    "drops": Faults(drop=0.2),
    "late": Faults(delay=0.5, delay_s=0.2),
    "duplicates": Faults(duplicate=0.05),
    "all": Faults(drop=0.05, duplicate=0.03, reorder=0.05, delay=0.2, delay_s=0.15),
}


def node(serial: int) -> Device:
    source = SimulatedSource(strain_matrix(FABRICATED, "I").tolist(), 5.0, seed=serial)
    return fingertip_node(5, source, serial=serial)


class Client:
    """A master: resets, configures and starts the node, sends SYNCs at 100 Hz, reads; repeats after 50 ms."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._request, self._sent_ms = b"", 0

    def step(self, ms: int) -> list[tuple[int, bytes]]:
        frames: list[tuple[int, bytes]] = [] if ms % 10 else [(0x080, b"")]
        if ms % 1500 == 0:
            frames.append((0x000, bytes((0x81, 5))))
        elif ms % 1500 == 50:  # heartbeat of 100 ms
            frames += [(0x605, bytes((0x2B, 0x17, 0x10, 0, 100, 0, 0, 0))), (0x000, bytes((1, 5)))]
        if not self._request and self._random.random() < 0.3:
            index, sub = self._random.choice(PLACES)
            self._request, self._sent_ms = struct.pack("<BHBI", 0x40, index, sub, 0), ms - 50
        if self._request and ms - self._sent_ms >= 50:
            frames.append((0x605, self._request))
            self._sent_ms = ms
        return frames

    def receive(self, can_id: int, data: bytes) -> None:
        if can_id == 0x585 and data[1:4] == self._request[1:4]:
            self._request = b""


def conversation(devices: Sequence[Device], faults: Faults, seed: int, seconds: float = 3.0) -> Iterator[Frame]:
    """Return what a listener gets of a bus with ``devices`` and a client; the nodes' ears are as bad as its own."""
    client, heard = Client(seed), Injector(faults, seed)
    to_nodes = Injector(Faults(drop=faults.drop, delay=faults.delay, delay_s=faults.delay_s), seed + 1)
    for ms in range(int(1000 * seconds)):
        frames = client.step(ms)
        for frame in frames:
            to_nodes.put(frame, ms * 1e-3)
        received = list(iter(lambda: to_nodes.take(ms * 1e-3), None))  # noqa: B023
        sent = [device.step(1000 * ms, received)[0] for device in devices]
        for k, device in enumerate(devices):
            sent[k] += device.step(1000 * ms, [frame for j, of in enumerate(sent) if j != k for frame in of])[0]
        for frame in frames + [frame for of in sent for frame in of]:
            client.receive(*frame)
            heard.put(frame, ms * 1e-3)
        while (due := heard.take(ms * 1e-3)) is not None:
            yield 1_000_000 * ms, *due


def causes(frames: Iterable[Frame], services: frozenset[int] | None = None) -> list[str]:
    """Return the findings of a listener, by its frames and by the samples decoded from them."""
    kept = [frame for frame in frames if services is None or frame[1] & ~0x7F in services or not frame[1]]
    watch, decoder = DuplicateNodes(), Decoder(3, [5])
    found = []
    for start in range(0, len(kept), 50):
        part = frame_array(kept[start : start + 50])
        found += [one.cause for one in find_duplicates(watch, part)]
        for samples in decoder.decode(part).values():
            add_samples(watch, samples, part, 256)
        found += [one.cause for one in watch.found.values()]
    return found


@pytest.mark.parametrize("name", BAD_BUSES)
def test_one_node_is_never_two(name: str) -> None:
    for seed in range(20):
        assert causes(conversation([node(1005)], BAD_BUSES[name], seed)) == [], f"seed {seed}"


@pytest.mark.parametrize(
    ("services", "serial", "cause"),
    [
        ({0x580, 0x600}, 1006, "two nodes respond as node 5"),
        ({0x580, 0x600}, 1005, "two nodes respond as node 5"),
        ({0x700}, 1005, "two nodes send heartbeats as node 5"),
        ({0x080}, 1005, "reports that another node sends its identifier 0x705 (EMCY 8150h)"),
        ({0x180}, 1006, "two nodes send the samples of node 5"),  # whose noise differs
    ],
)
def test_two_nodes_are_found_by_each_service(services: set[int], serial: int, cause: str) -> None:
    frames = conversation([node(1005), node(serial)], Faults(), seed=1)
    assert any(cause in found for found in causes(frames, frozenset(services)))


@pytest.mark.parametrize("name", BAD_BUSES)
def test_two_nodes_are_found_on_a_faulty_bus(name: str) -> None:
    for seed in range(5):
        assert causes(conversation([node(1005), node(1006)], BAD_BUSES[name], seed)), f"seed {seed}"


def heard(*frames: Frame) -> list[str]:
    return [one.cause for one in find_duplicates(DuplicateNodes(), frame_array(frames))]


def beats(times_ms: Iterable[int], states: Sequence[int] = (5,)) -> list[Frame]:
    return [(1_000_000 * ms, 0x705, bytes((states[k % len(states)],))) for k, ms in enumerate(times_ms)]


@pytest.mark.parametrize(
    ("times_ms", "states", "found"),
    [
        ([t for k in range(6) for t in (1000 * k, 1000 * k + 200)], (5,), True),
        ([t for k in range(6) for t in (1000 * k, 1000 * k)], (5,), True),  # in one loop
        ([500 * k for k in range(12)], (5, 127), True),  # states alternate
        ([500 * k for k in range(12)], (5,), False),  # one node could send them
        ([t for k in range(12) for t in (60 * k, 60 * k + 20)], (5,), False),  # 30 ms in a cycle of 20 ms
        ([40 * (k // 2) for k in range(30)], (5,), False),  # 20 ms, read every 40 ms
        ([100 * k + 30 * (k % 3) for k in range(30)], (5,), False),  # jitter
    ],
)
def test_heartbeats(times_ms: list[int], states: tuple[int, ...], found: bool) -> None:
    assert ("two nodes send heartbeats as node 5" in heard(*beats(times_ms, states))) is found


def test_states_that_a_master_commands_are_those_of_one_node() -> None:
    commanded = [
        frame
        for k, beat in enumerate(beats([500 * k for k in range(20)], (5, 127)))
        for frame in ((beat[0], 0x000, bytes(((1, 128)[k % 2], k % 4 and 5))), beat)
    ]
    assert heard(*commanded) == []


@pytest.mark.parametrize("both", [False, True])
def test_node_guarding_and_the_boot_up_after_a_reset(both: bool) -> None:
    guarding = [
        frame
        for k in range(40)
        for frame in ((k, 0x40000705, b""), *[(k, 0x705, bytes((5 | k % 2 << 7,)))] * (1 + both))
    ]
    booting = [frame for k in range(10) for frame in ((k, 0x000, b"\x82\x05"), *[(k, 0x705, b"\x00")] * (1 + both))]
    watch = DuplicateNodes()
    find_duplicates(watch, frame_array([(0, 0x705, b"\x7f")]))
    assert [one.cause for one in find_duplicates(watch, frame_array(booting))][:1] == [
        "two nodes boot as node 5"
    ] * both
    assert heard(*guarding) == ["two nodes respond as node 5"] * both


def test_a_boot_up_ends_a_finding_and_another_serial_number_after_it_is_another_node() -> None:
    watch = DuplicateNodes()

    def read(*serials: int) -> list[str]:
        responses = [(0, 0x585, bytes((0x43, 0x18, 0x10, 4)) + serial.to_bytes(4, "little")) for serial in serials]
        return [str(one) for one in find_duplicates(watch, frame_array([(0, 0x605, READ_SERIAL), *responses]))]

    assert read(7) == []
    assert read(7, 8) == [
        "two nodes respond as node 5 (serial numbers 7, 8): give one of them another node-id: "
        "`tipforce lss assign ID --serial 8`, then `tipforce nmt reset-comm 5`"
    ]
    assert read(7, 8) == []  # known
    find_duplicates(watch, frame_array([(0, 0x705, b"\x00")]))
    assert watch.found == {}
    assert read(9) == []


def test_responses_to_other_and_to_repeated_requests_are_no_second_ones() -> None:
    """Another master reads what this one, whose own frames are not recorded, reads again and again; a client repeats
    its request and gets late responses."""
    response, frames = bytes((0x43, 0x18, 0x10, 4, 7, 0, 0, 0)), list[Frame]()
    for k in range(100):
        frames += [(10_000_000 * k, 0x605, READ_SERIAL)] * (k % 10 == 0) + [(10_000_000 * k, 0x585, response)]
    assert heard(*frames) == []
    for repeats in range(1, 12):
        frames = [(0, 0x605, READ_SERIAL)] * repeats + [(0, 0x585, response)] * repeats
        assert heard(*frames * 20) == []
