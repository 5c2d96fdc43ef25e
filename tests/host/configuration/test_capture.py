"""Steps of a guided calibration, from flags and plans; gauge readings by PDO, by SDO, and what does not count."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from host.bus_with_nodes import apply_load, connected, finger
from tipforce.dictionary import objects as od
from tipforce.dictionary.entries import Entry
from tipforce.errors import InputError, NoResponseError
from tipforce.host.configuration.capture import RESOLUTION_MICROSTRAIN, Capture, GaugeReader
from tipforce.host.configuration.guide import file_plan, groove_plan
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.structure.strain import FABRICATED, strain_matrix
from tipforce.sources.simulated import OPEN, SATURATED, SILENT

LOAD = (4.4, 90.0, 45.0)
EXPECTED = strain_matrix(FABRICATED, "I") @ force_vector(4.4, np.pi / 2, np.pi / 4) * 1e6
NO_PDO = 0xC0000185


def test_by_pdo() -> None:
    with connected(finger(noise_microstrain=0.5)) as (connection, bus):
        apply_load(connection, 5, *LOAD)
        reader = GaugeReader(connection, 5, 3, period_s=0.001)
        assert reader.how == "SYNC and TPDO1 (0x185)"
        seen: list[int] = []
        capture = reader.capture(40, seen.append)
        assert capture.count == 40 == capture.asked
        assert seen[-1] == 40
        assert (capture.silent, capture.repeated, capture.faulty, capture.saturated) == (0, 0, 0, (0, 0, 0))
        np.testing.assert_allclose(capture.mean, EXPECTED, atol=6 * 0.5 / np.sqrt(40))
        assert (capture.std > 0.2).all()
        assert (capture.std < 1.0).all()
        np.testing.assert_allclose(np.sqrt(np.diag(capture.covariance)), capture.std)
        assert capture.temperature_degC == 23.0
        reader.stop()
        assert (0, bytes((1, 5))) in bus.sent
        assert bus.sent[-1] == (0, bytes((128, 5)))


def test_a_node_that_was_operational_stays_so() -> None:
    with connected(finger()) as (connection, bus):
        connection.nmt("start", 5)
        reader = GaugeReader(connection, 5, 3, period_s=0.001)
        reader.capture(5)
        reader.stop()
        assert [frame for frame in bus.sent if frame[0] == 0] == [(0, bytes((1, 5)))]


@pytest.mark.parametrize(
    ("entry", "value"),
    [(od.TPDO1_COB_ID, NO_PDO), (od.TPDO1_TRANSMISSION_TYPE, 2), (od.TPDO1_MAPPED, 3)],
    ids=lambda x: str(x).partition(" ")[0] if not isinstance(x, int) else "",
)
def test_by_sdo_where_tpdo1_does_not_serve(entry: Entry[int], value: int) -> None:
    with connected(finger()) as (connection, _):
        sdo = connection.sdo(5)
        sdo.write(od.TPDO1_COB_ID, NO_PDO)
        sdo.write(entry, value)
        if entry != od.TPDO1_COB_ID:
            sdo.write(od.TPDO1_COB_ID, NO_PDO & 0x7FFFFFFF)
        apply_load(connection, 5, *LOAD)
        reader = GaugeReader(connection, 5, 3, period_s=0.001)
        assert reader.how == "SYNC and SDO reads"
        capture = reader.capture(3)
        assert capture.count == 3
        np.testing.assert_allclose(capture.mean, EXPECTED, atol=RESOLUTION_MICROSTRAIN)
        reader.stop()


@pytest.mark.parametrize("by_pdo", [True, False])
def test_a_node_that_a_killed_hand_left_numbered(by_pdo: bool) -> None:
    with connected(finger()) as (connection, _):
        connection.sdo(5).write(od.SYNC_COUNTER_OVERFLOW, 240)
        if not by_pdo:
            connection.sdo(5).write(od.TPDO1_COB_ID, NO_PDO)
        apply_load(connection, 5, *LOAD)
        reader = GaugeReader(connection, 5, 3, period_s=0.001)
        assert reader.moves()
        np.testing.assert_allclose(reader.capture(5).mean, EXPECTED, atol=RESOLUTION_MICROSTRAIN)
        reader.stop()
        assert connection.finger(5).read().P_newtons != 0.0
        status = connection.sdo(5)  # a node on a busy machine may be late with one conversion
        assert any(status.read(od.STATUS) & 8 == 0 for _ in range(100))


def test_another_identifier_and_another_order() -> None:
    with connected(finger()) as (connection, _):
        sdo = connection.sdo(5)
        sdo.write(od.TPDO1_COB_ID, NO_PDO)
        sdo.write(od.TPDO1_MAPPED, 0)
        for sub, word in enumerate((0x21210008, 0x71300310, 0x71300110, 0x71300210, 0x21200008), 1):
            sdo.write(od.TPDO1_MAPPING[sub], word)
        sdo.write(od.TPDO1_MAPPED, 5)
        sdo.write(od.TPDO1_COB_ID, 0x400001A5)
        apply_load(connection, 5, *LOAD)
        reader = GaugeReader(connection, 5, 3, period_s=0.001)
        assert reader.how == "SYNC and TPDO1 (0x1A5)"
        np.testing.assert_allclose(reader.capture(4).mean, EXPECTED, atol=RESOLUTION_MICROSTRAIN)


@pytest.mark.parametrize("by_pdo", [True, False])
def test_what_does_not_count_is_counted(by_pdo: bool) -> None:
    with connected(finger(noise_microstrain=0.5)) as (connection, _):
        sdo = connection.sdo(5)
        if not by_pdo:
            sdo.write(od.TPDO1_COB_ID, NO_PDO)
        reader = GaugeReader(connection, 5, 3, period_s=0.001)
        sdo.write(od.SIMULATION_GAUGE, 2)

        def with_fault(fault: int) -> Capture:
            sdo.write(od.SIMULATION_FAULT, fault)
            return reader.capture(10)

        saturated = with_fault(SATURATED)
        assert saturated.count == 0
        assert saturated.saturated[0] == saturated.saturated[2] == 0
        assert saturated.saturated[1] >= 10
        broken = with_fault(OPEN)
        assert broken.faulty >= 10
        assert broken.faults == 0x402
        silent = with_fault(SILENT)
        assert silent.count == 0
        assert silent.stale >= 10
        assert not reader.moves()
        assert with_fault(0).count == 10
        assert reader.moves()


def test_stale_samples_are_replaced() -> None:
    """At a sample period of 5 ms and a SYNC each millisecond most samples are stale; the reader slows down."""
    with connected(finger()) as (connection, _):
        connection.sdo(5).write(od.SAMPLE_PERIOD_US[1], 5000)
        reader = GaugeReader(connection, 5, 3, period_s=0.001)
        assert reader.period_s == 0.005
        reader.period_s = 0.003
        capture = reader.capture(20)
        assert capture.stale > 0
        assert capture.count > 12


def test_drift_and_floor() -> None:
    t_s = np.linspace(0.0, 2.0, 50)
    microstrain = np.stack((3.0 * t_s, -t_s, np.full(50, 7.0)), axis=-1)
    capture = Capture(microstrain, t_s, 50, (0, 0, 0), 0, 0, 0, 0, 0, None)
    np.testing.assert_allclose(capture.drift, [6.0, -2.0, 0.0], atol=1e-12)
    assert capture.covariance[2, 2] == pytest.approx(RESOLUTION_MICROSTRAIN**2 / 12)
    assert capture.duration_s == 2.0
    assert not Capture(np.ones((3, 3)), np.zeros(3), 3, (0, 0, 0), 0, 0, 0, 0, 0, None).drift.any()
    of_the_epoch = 1.7e9 + np.cumsum([0.0, *[1e-3, 1.1e-3] * 5])
    still = Capture(np.full((11, 3), 900.1), of_the_epoch, 11, (0, 0, 0), 0, 0, 0, 0, 0, None)
    np.testing.assert_allclose(still.drift, 0.0, atol=1e-9)


def test_a_node_that_goes_and_comes_back() -> None:
    with connected(finger()) as (connection, _):
        reader = GaugeReader(connection, 5, 3, period_s=0.001)
        assert reader.capture(5).count == 5
        connection.nmt("reset-node", 5)  # as if it had lost its power
        connection.wait_for({0x705}, 10.0)
        assert reader.capture(5).count == 5
        connection.nmt("stop", 5)
        connection.sdo(5).timeout_s, connection.sdo(5).retries = 0.05, 0  # from here on nothing responds
        reader.start = lambda: None  # type: ignore[method-assign]  # else it would start the node again
        with pytest.raises(NoResponseError, match="node 5"):
            reader.capture(5)


def test_pdos_alone_are_missing() -> None:
    with connected(finger()) as (connection, bus):
        reader = GaugeReader(connection, 5, 3, period_s=0.001)
        bus.fault = lambda message: None if message.arbitration_id == 0x185 else message
        capture = reader.capture(10)
        assert capture.count == 0
        assert capture.silent >= 5


# --- steps -----------------------------------------------------------------------------------------------------

RIG = """
tare_every = 2
[[step]]
P_N = 1.5
phi_deg = 10
theta_deg = 40
[[step]]
P_N = 2
phi_deg = -170
theta_deg = 90
mode = "push"
instruction = "press with the stamp"
[[step]]
P_N = 2
phi_deg = 90
theta_deg = 20
[[step]]
P_N = 2
phi_deg = -90
theta_deg = 60
"""


def test_the_papers_grooves() -> None:
    steps = groove_plan("4.4,2.2", "paper")
    loads = [step for step in steps if step.mode != "tare"]
    assert [step.number for step in steps] == list(range(1, len(steps) + 1))
    assert len(loads) == 2 * 19
    assert {step.P_newtons for step in loads} == {4.4, 2.2}
    assert steps[0].mode == steps[-1].mode == "tare"
    assert loads[2].load == (4.4, 0.0, 30.0, "pull")
    assert loads[2].instruction == "hang 4.4 N (448.7 g) in the x-groove at theta = 30 degrees (phi = 0)"
    assert loads[9].load == (4.4, 180.0, 175.0, "pull")
    assert loads[10].load == (4.4, 90.0, 30.0, "pull")
    assert all(b - a <= 5 for a, b in pairwise([k for k, step in enumerate(steps) if step.mode == "tare"]))


@pytest.fixture
def plan(tmp_path: Path) -> Callable[[str], Path]:
    def write(text: str) -> Path:
        path = tmp_path / "plan.toml"
        path.write_text(text)
        return path

    return write


def test_a_plan_file(plan: Callable[[str], Path]) -> None:
    steps = file_plan(plan(RIG))
    assert [step.mode for step in steps] == ["tare", "pull", "push", "tare", "pull", "pull", "tare"]
    assert steps[1].instruction == "pull with 1.5 N at theta = 40 degrees (phi = 10)"
    assert steps[2].instruction == "press with the stamp"
    own = file_plan(plan(RIG + '[[step]]\nmode = "tare"\ninstruction = "lift the stamp"\n'))
    assert [step.mode for step in own] == ["pull", "push", "pull", "pull", "tare"]
    assert own[-1].instruction == "lift the stamp"


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("P_N = 1.5", "P_N = 0", "step 1: P_N = 0: allowed is above 0"),
        ("P_N = 1.5", "P_N = nan", "step[1].P_N is nan: allowed are finite numbers"),
        ("phi_deg = 10", "phi_deg = 1000", "step 1: phi_deg = 1000.0: allowed is -720 to 720"),
        ("theta_deg = 90", "", "step 2: theta_deg = None"),
        ('"push"', '"twist"', "step[2].mode is 'twist': invalid enum value 'twist'; allowed: pull, push, tare"),
        ('"push"', '"tare"', "step 2 is a tare, an unloaded reading"),
        ("tare_every = 2", "tare_every = 0", "tare_every = 0: allowed is 1 or more"),
        (
            "every = 2",
            "evry = 2",
            "plan.toml: tare_evry: no such key; did you mean tare_every? allowed: step, tare_every",
        ),
        ("theta_deg = 40", "theta = 40", "step[1].theta: no such key; did you mean theta_deg?"),
        ("phi_deg = 10", 'phi_deg = "10"', "step[1].phi_deg is '10': expected float, got str"),
        ("phi_deg = 10", "phi_deg =", "plan "),
    ],
)
def test_a_plan_file_that_is_wrong(plan: Callable[[str], Path], old: str, new: str, reason: str) -> None:
    with pytest.raises(InputError, match=r"plan .*plan.toml: ") as caught:
        file_plan(plan(RIG.replace(old, new, 1)))
    assert reason in str(caught.value)


def test_a_plan_without_a_load(plan: Callable[[str], Path]) -> None:
    with pytest.raises(InputError, match="no step has a load"):
        file_plan(plan('[[step]]\nmode = "tare"\n'))
