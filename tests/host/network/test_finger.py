"""A calibration on its way into a node: taken whole, or refused with nothing changed."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import can
import numpy as np
import pytest

from host.bus_with_nodes import ROUNDING_STRAIN2, FaultyBus, apply_load, beam_calibration, connected, finger
from tipforce.dictionary import objects as od
from tipforce.dictionary import table
from tipforce.errors import InputError, RefusedError, SdoAbortError
from tipforce.host.configuration.calibration import Calibration, difference
from tipforce.host.network.bus import Bus
from tipforce.host.network.finger import Finger
from tipforce.sensor.structure.strain import FABRICATED, calibration_matrix

NODE = 5
LOAD = (4.4, 90.0, 60.0)


class Bench(NamedTuple):
    connection: Bus
    bus: FaultyBus
    client: Finger
    active: Calibration

    def state(self) -> tuple[object, ...]:
        """All that must stay as it is when a node refuses: CRC, record, generation, and what the PDO says."""
        sdo, contact = self.client.sdo, self.client.read()
        return (
            sdo.read(od.CALIBRATION_ACTIVE_CRC), sdo.read(od.CALIBRATION_ACTIVE_RECORD),
            sdo.read(od.CALIBRATION_GENERATION), (contact.P_newtons, contact.phi_deg, contact.theta_deg),
        )  # fmt: skip


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with connected(finger(NODE, store=tmp_path / "node.json")) as (connection, bus):
        client, active = connection.finger(NODE), beam_calibration()
        client.apply_calibration(active)
        apply_load(connection, NODE, *LOAD)
        yield Bench(connection, bus, client, active)


def assert_contact(state: tuple[object, ...], P: float, phi: float, theta: float) -> None:
    # Half a count of each gauge is the only error of a noiseless finger.
    assert state[3] == pytest.approx((P, phi, theta), abs=0.05)


def test_taken(bench: Bench) -> None:
    before = bench.state()
    assert before[:3] == (bench.active.crc32(), bench.active.record(), 1)
    assert_contact(before, *LOAD)
    steps: list[str] = []
    doubled = beam_calibration(C=2.0 * bench.active.C, serial=8)
    assert bench.client.apply_calibration(doubled, on_step=steps.append) == 2
    assert [step.split()[0].rstrip(",") for step in steps] == ["staged", "committed", "read", "stored"]
    assert f"0x{doubled.crc32():08X}" in steps[0]
    after = bench.state()
    assert after[:3] == (doubled.crc32(), doubled.record(), 2)
    assert_contact(after, 2 * LOAD[0], *LOAD[1:])
    assert bench.client.verify_calibration(doubled) == []


def test_stored_or_not(bench: Bench) -> None:
    bench.client.apply_calibration(beam_calibration(serial=9), store=False)
    bench.connection.buffer.clear()
    bench.connection.nmt("reset-node", NODE)
    bench.connection.wait_for({0x700 + NODE}, 10.0)
    assert bench.client.verify_calibration(bench.active) == []


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """A host that sends a calibration without checking it: the node refuses it all the same."""
    monkeypatch.setattr(Calibration, "check", lambda _calibration: None)


def test_the_host_sends_no_calibration_that_no_sensor_can_have(bench: Bench) -> None:
    bench.bus.sent.clear()
    with pytest.raises(InputError, match="matrix: rank below 3"):
        bench.client.apply_calibration(beam_calibration(C=np.zeros((3, 3))))
    assert not bench.bus.sent


CROSSED = ({"theta_min_deg": 170.0, "theta_max_deg": 10.0}, {"contact_on_newtons": 0.01, "contact_off_newtons": 0.02})


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"tip_radius_m": np.nan}, r"0x06090030\): a value is not finite"),
        *((changes, r"0x06090030\): .*theta minimum over maximum, contact-off over") for changes in CROSSED),
        ({"C": np.ones((3, 3))}, r"0x06090031\): the condition number of C exceeds the limit 2105h:1"),
    ],
)  # fmt: skip
def test_the_node_refuses_what_no_sensor_can_have(bench: Bench, changes: dict[str, object], text: str) -> None:
    before = bench.state()
    with pytest.raises(RefusedError, match=r"node 5 rejected the calibration \(" + text):
        bench.client.apply_calibration(beam_calibration(**changes))
    assert bench.state() == before


def test_the_limit_of_the_condition_number_is_the_nodes(bench: Bench) -> None:
    bench.client.sdo.write(od.CALIBRATION_CONDITION_LIMIT, 1.0)
    with pytest.raises(RefusedError, match="06090031"):
        bench.client.apply_calibration(bench.active)


def test_locked_is_refused_and_says_how_to_unlock(bench: Bench) -> None:
    before = bench.state()
    bench.client.sdo.write(od.CALIBRATION_LOCK, 1)
    with pytest.raises(RefusedError, match=r"0x08000022\): it is locked .*tipforce sdo write ID calibration\.unlock"):
        bench.client.apply_calibration(beam_calibration(serial=9))
    assert bench.state() == before
    bench.client.sdo.write(od.CALIBRATION_UNLOCK, table.SIGNATURE_OPEN)
    assert bench.client.apply_calibration(beam_calibration(serial=9)) == 2


def test_an_abort_that_is_no_refusal_stays_an_abort(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """A commit whose signature was corrupted on the way says nothing about the calibration."""
    send = bench.bus.send

    def corrupting(message: can.Message, timeout: float | None = None) -> None:
        if message.data[:4] == b"\x23\x04\x21\x00":
            message.data[7] ^= 0x01
        send(message, timeout)

    monkeypatch.setattr(bench.bus, "send", corrupting)
    with pytest.raises(SdoAbortError, match="08000020"):
        bench.client.apply_calibration(beam_calibration())


@pytest.mark.parametrize("segment", range(16))
def test_a_frame_corrupted_on_the_way_is_noticed(bench: Bench, monkeypatch: pytest.MonkeyPatch, segment: int) -> None:
    """What left the host is not what the node got: its CRC-32 differs from the expected one, so it refuses."""
    bench.client.sdo.has_blocks = False  # segments have no CRC of their own
    before = bench.state()
    send = bench.bus.send
    segments = iter(range(1000))

    def corrupting(message: can.Message, timeout: float | None = None) -> None:
        if message.arbitration_id == 0x600 + NODE and message.data[0] >> 5 == 0 and next(segments) == segment:
            message.data[1] ^= 0x10
        send(message, timeout)

    monkeypatch.setattr(bench.bus, "send", corrupting)
    # The last byte is the load sense, which the node checks at once.
    code = "0x06040043): the CRC-32 of the received data is wrong" if segment < 15 else "0x06090030): "
    with pytest.raises(RefusedError, match=re.escape(code)):
        bench.client.apply_calibration(beam_calibration(serial=9))
    assert bench.state() == before


def flipping(bench: Bench, segment: int, first_byte: Callable[[int], bool]) -> Iterator[int]:
    """Flip one bit of a response whose first byte is such; return the numbers of those that follow."""
    seen = iter(range(1000))

    def corrupting(message: can.Message) -> can.Message:
        chosen = message.arbitration_id == 0x580 + NODE and first_byte(message.data[0])
        if chosen and next(seen) == segment:
            message.data[3] ^= 0x40
        return message

    bench.bus.fault = corrupting
    return seen


def test_a_node_that_holds_something_else_is_caught(bench: Bench) -> None:
    """A known updater reads back and does not compare (docs/dependencies.md). Here a read-back segment is corrupted."""
    bench.client.sdo.has_blocks = False
    flipping(bench, 2, lambda first: first >> 5 == 0)
    with pytest.raises(RefusedError, match=r"the active calibration differs from the one sent: 0x2100:0\d: expected"):
        bench.client.apply_calibration(bench.active)


def test_a_record_read_back_with_one_flipped_bit_is_refused(bench: Bench) -> None:
    """2103h:3 is the CRC-32 of what the node holds: a flip on the way is no calibration."""
    bench.client.sdo.has_blocks = False
    flipping(bench, 4, lambda first: first >> 5 == 0)
    with pytest.raises(RefusedError, match=r"record read back \(2140h\) has CRC-32 0x[0-9A-F]{8}, the node says 0x"):
        bench.client.calibration()


def test_a_block_with_one_flipped_bit_is_read_again(bench: Bench) -> None:
    following = flipping(bench, 0, lambda first: first == 5)
    found = bench.client.calibration()
    assert found is not None
    assert found.record() == bench.active.record()
    assert next(following) > 0, "a segment was corrupted"


def test_another_number_of_gauges_never_leaves_the_host(bench: Bench) -> None:
    layout = ("K_H", "S_H", "U", "L")
    four = Calibration(calibration_matrix(FABRICATED, layout), np.zeros(4), np.eye(4) * 1e-12)
    bench.bus.sent.clear()
    with pytest.raises(InputError, match=r"product code 0x54500103 has 3 gauges, the calibration has 4"):
        bench.client.apply_calibration(four)
    assert {data[0] for _, data in bench.bus.sent} == {0x40}, "only reads"


def test_storing_that_fails_is_an_abort_and_the_calibration_active() -> None:
    """No --store: the node refuses 1010h. Active is what was committed, and the error says that storing failed."""
    with connected(finger(NODE)) as (connection, _):
        client = connection.finger(NODE)
        with pytest.raises(SdoAbortError, match="write of 0x1010:04"):
            client.apply_calibration(beam_calibration())
        assert client.verify_calibration(beam_calibration()) == []
        with pytest.raises(SdoAbortError, match="write of 0x1010:01"):
            client.store()


# --- verify ---------------------------------------------------------------------------------------------------------


def changed_C(k: int) -> dict[str, object]:
    C = beam_calibration().C.copy()
    C.flat[k] *= 1.001
    return {"C": C}


@pytest.mark.parametrize(
    ("changes", "place"),
    [
        (changed_C(0), "0x2100:01"), (changed_C(8), "0x2100:09"),
        ({"offset_strain": np.array([0.0, 1e-6, 0.0])}, "0x2101:02"), ({"serial": 99}, "0x2102:01"),
        ({"date": 20250101}, "0x2102:02"), ({"layout_code": 3}, "0x2102:04"),
        ({"covariance_strain2": np.eye(3) * ROUNDING_STRAIN2 + np.eye(3)[::-1] * 1e-17}, "0x2106:03"),
        ({"tip_radius_m": 0.016}, "0x2110:01"), ({"pull": False}, "0x2110:06"),
    ],
)  # fmt: skip
def test_verify_names_the_field_and_both_values(bench: Bench, changes: dict[str, object], place: str) -> None:
    lines = bench.client.verify_calibration(beam_calibration(**changes))
    assert any(line.startswith(f"{place}: expected ") and "the node has" in line for line in lines), lines
    assert len(lines) <= 2


def test_verify_of_an_uncalibrated_node() -> None:
    with connected(finger(NODE)) as (connection, _):
        client = connection.finger(NODE)
        assert client.calibration() is None
        assert client.verify_calibration(beam_calibration()) == ["the node has no active calibration"]


def test_records_of_different_length() -> None:
    assert difference(bytes(158), bytes(158)) == []
    assert difference(bytes(158), bytes(157)) == ["length: expected 158 bytes, the node has 157"]
