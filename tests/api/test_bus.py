"""tipforce.open and fingers: on names, on an open bus, on a canopen.Network that others use; samples as they come."""

import asyncio
import dataclasses
import itertools
import math
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import canopen
import numpy as np
import pytest
from bench.measure import background

import tipforce
from tipforce.dictionary import objects as od
from tipforce.host import apply_configuration, read_configuration
from tipforce.host.network import finger as module
from tipforce.host.network import finger_samples as samples
from tools.rig import Clock, message, sending, until

LOAD = (4.4, 90.0, 45.0)


@pytest.fixture
def bus() -> Iterator[tipforce.SimulatedBus]:
    with tipforce.simulated_finger(5, load=LOAD) as found:
        yield found


def close_to(contact: tipforce.Contact, load: tuple[float, float, float]) -> bool:
    """Within five standard uncertainties."""
    found = (contact.P_newtons, contact.phi_deg, contact.theta_deg)
    u = (contact.u_P_newtons, contact.u_phi_deg, contact.u_theta_deg)
    return all(abs(a - b) < 5.0 * c for a, b, c in zip(found, load, u, strict=True))


def test_a_contact_has_its_values_uncertainties_and_status(bus: tipforce.SimulatedBus) -> None:
    contact = bus.finger(5).read()
    assert close_to(contact, LOAD)
    assert 0.0 < contact.u_P_newtons < 0.02
    assert contact.ok
    assert contact.present
    assert contact.status == tipforce.Status.CONTACT | tipforce.Status.CALIBRATED
    assert np.allclose(contact.F_newtons, (4.4, 4.4 * math.sin(math.radians(45.0)), 0.0), atol=0.1)
    assert len(contact.microstrain) == 3
    assert abs(contact.t_s - time.time()) < 60.0
    assert "N, phi" in str(contact)


def test_each_reading_is_a_new_sample(bus: tipforce.SimulatedBus) -> None:
    """Polling as fast as Python can: each sample once, in order, and never NaN for a repeated one."""
    finger = bus.finger(5)
    found = [finger.read() for _ in range(20)]
    assert 0 not in {(b.counter - a.counter) % 256 for a, b in itertools.pairwise(found)}
    assert all(contact.ok for contact in found)
    bus.inject_fault(5, "silent")  # a live finger may send between two calls
    with pytest.raises(tipforce.NoNewSampleError):
        list(itertools.islice(finger.samples(timeout_s=0.3), 1000))
    with pytest.raises(tipforce.NoNewSampleError, match=r"^finger 5: no new sample"):
        finger.read(timeout_s=0)


def test_what_is_read_of_the_node_is_no_part_of_the_wait_for_a_sample(
    bus: tipforce.SimulatedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    times = SimpleNamespace(monotonic=lambda: time.monotonic() + clock.now_s, time=time.time)
    for each in (module, samples):
        monkeypatch.setattr(each, "time", times)
    monkeypatch.setattr(module.Finger, "calibration", lambda _finger: clock.sleep(1000.0))
    assert bus.finger(5).read(timeout_s=60.0).P_newtons == pytest.approx(4.4, abs=0.1)


def test_of_two_threads_that_read_one_finger_one_takes_a_sample(
    bus: tipforce.SimulatedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    finger = bus.finger(5)
    finger.read()
    reader = finger._reader
    assert reader is not None
    feed, inside, entered = reader._assembler.feed, threading.Lock(), threading.Event()

    def alone(*frames: Any) -> Any:
        if not inside.acquire(blocking=False):
            entered.set()
            return feed(*frames)
        other = threading.Thread(target=finger.read)
        other.start()
        entered.wait(0.05)  # of a second one, which would come at once
        found = feed(*frames)
        others.append(other)
        inside.release()
        return found

    others = list[threading.Thread]()
    with monkeypatch.context() as patch:
        patch.setattr(reader._assembler, "feed", alone)
        finger.read()
    for other in others:
        other.join()
    assert not entered.is_set()


@pytest.mark.parametrize("by_another", [False, True])
def test_a_new_calibration_gives_the_uncertainties_at_once(bus: tipforce.SimulatedBus, by_another: bool) -> None:
    finger = bus.finger(5)
    u_newtons, calibration = finger.read().u_P_newtons, finger.calibration()
    assert calibration is not None
    noisy = dataclasses.replace(calibration, covariance_strain2=1e4 * calibration.covariance_strain2)
    with tipforce.open(**bus.bus_options) as other:
        bus.sync()  # an answer that is not read yet is of the calibration before
        (other.finger(5) if by_another else finger).apply_calibration(noisy, store=False)
    assert finger.read().u_P_newtons == pytest.approx(100.0 * u_newtons, rel=0.1)


def test_a_finger_that_another_master_remaps_and_that_boots_is_read_anew(
    bus: tipforce.SimulatedBus, tmp_path: Path
) -> None:
    path = tmp_path / "swapped.toml"
    words = (f"process_value_int16:{k}" for k in (7, 9, 8))
    path.write_text(f'[objects]\n"tpdo2.mapping" = {[*words, "status", "counter"]}\n')
    with tipforce.open(**bus.bus_options) as opened, tipforce.open(**bus.bus_options) as other:
        finger, stream = opened.finger(5), opened.finger(5).samples(timeout_s=5.0)
        assert close_to(next(stream), LOAD)
        for master in (other, opened):
            apply_configuration(master.sdo(5), read_configuration(path, 5))
            assert close_to(next(stream), LOAD)
            other.nmt("reset-node", 5)
            until(lambda: opened.heartbeats.state(5) == 0x7F)
            assert close_to(finger.read(5.0), LOAD)


def test_boot_ups_without_end_are_an_error_in_time(bus: tipforce.SimulatedBus) -> None:
    with (
        tipforce.open(**bus.bus_options) as opened,
        sending(bus.bus_options["channel"], lambda _number: [message(0x705, b"\0")], 0.001),
    ):
        stream = opened.finger(5).samples(timeout_s=0.3)
        for reading in (partial(opened.finger(5).read, 0.3), partial(next, stream)):
            with pytest.raises(tipforce.NoNewSampleError, match="finger 5: no new sample"):
                _ = [reading() for _ in range(1000)]


def test_samples_follow_the_load(bus: tipforce.SimulatedBus) -> None:
    stream = bus.finger(5).samples(timeout_s=2.0, rate_hz=200.0)
    assert all(contact.ok for contact in itertools.islice(stream, 10))
    bus.apply_load(5, 1.0, 90.0, 60.0)
    assert any(close_to(contact, (1.0, 90.0, 60.0)) for contact in itertools.islice(stream, 20))


def test_asyncio_reads_while_other_tasks_run(bus: tipforce.SimulatedBus) -> None:
    async def read() -> tuple[list[tipforce.Contact], int]:
        found: list[tipforce.Contact] = []
        turns = 0

        async def other() -> None:
            nonlocal turns
            while len(found) < 5:
                turns += 1
                await asyncio.sleep(0)

        task = asyncio.create_task(other())
        async for contact in bus.finger(5).samples():
            found.append(contact)
            if len(found) == 5:
                break
        await task
        return found, turns

    found, turns = asyncio.run(read())
    assert [contact.ok for contact in found] == [True] * 5
    assert turns > 5


def test_an_object_by_its_name(bus: tipforce.SimulatedBus) -> None:
    sdo = bus.finger(5).sdo
    assert sdo["identity.serial"] == sdo["0x1018:04"] == 1005
    sdo["heartbeat.producer_ms"] = 250
    assert sdo.read(od.HEARTBEAT_PRODUCER_MS) == 250
    for name in (3, None):
        with pytest.raises(tipforce.InputError, match="allowed is a name such as"):
            _ = sdo[name]  # type: ignore[index]
    for node_id in (0, 128, "5"):
        with pytest.raises(tipforce.InputError, match="allowed are 1 to 127"):
            bus.finger(node_id)  # type: ignore[arg-type]
    with pytest.raises(tipforce.InputError, match=r"close to it: calibration\.serial"):
        _ = sdo["calibration.serail"]


def test_another_producers_sync_is_used_and_none_is_sent(bus: tipforce.SimulatedBus) -> None:
    finger = bus.finger(5)
    with can.Bus(interface="virtual", channel=bus.bus_options["channel"]) as other:

        def produce(stop: threading.Event) -> None:
            while not stop.wait(0.02):
                other.send(message(0x80))

        with background(produce):
            list(itertools.islice(finger.samples(), 5))
            while other.recv(0) is not None:
                pass
            list(itertools.islice(finger.samples(), 10))
            heard = {each.arbitration_id for each in iter(lambda: other.recv(0), None)}
    assert 0x285 in heard
    assert 0x80 not in heard  # what this bus sends it does not hear: any would be ours


def test_a_passive_finger_sends_nothing(bus: tipforce.SimulatedBus) -> None:
    options = bus.bus_options
    with can.Bus(**options) as ear, tipforce.open(**options) as listener:
        finger = listener.finger(5, passive=True)
        with pytest.raises(tipforce.NoNewSampleError, match="no frame with identifier"):
            finger.read(timeout_s=0.1)
        assert ear.recv(0) is None
        with sending(options["channel"], lambda _number: (message(0, b"\x01\x05"), message(0x80)), 0.02):
            contact = finger.read(timeout_s=5.0)
    assert math.isclose(contact.P_newtons, 4.4, abs_tol=0.1)
    assert math.isnan(contact.u_P_newtons)  # no calibration is known


def test_a_finger_is_one_object_for_the_same_arguments(bus: tipforce.SimulatedBus) -> None:
    with tipforce.open(**bus.bus_options) as opened:
        finger, listener = opened.finger(5), opened.finger(5, passive=True)
        assert opened.finger(5) is finger is not listener is opened.finger(5, passive=True)


def test_a_bus_of_yours_stays_open(bus: tipforce.SimulatedBus) -> None:
    with can.Bus(**bus.bus_options) as mine:
        with tipforce.open(mine) as opened:
            assert opened.finger(5).read().ok
        assert not can.Notifier.find_instances(mine)
        mine.send(message(0x80))
        assert mine.recv(2.0) is not None


def test_a_bus_with_a_notifier_of_yours_keeps_it(bus: tipforce.SimulatedBus) -> None:
    heard: list[int] = []
    with can.Bus(**bus.bus_options) as mine:
        notifier = can.Notifier(mine, [lambda message: heard.append(message.arbitration_id)])
        with tipforce.open(mine) as opened:
            assert opened.finger(5).read().ok
        before = len(heard)
        assert not notifier.stopped
        assert len(notifier.listeners) == 1
        mine.send(message(0x80))
        until(lambda: len(heard) > before)
        notifier.stop()
    assert 0x285 in heard[before:]


def callbacks_of(network: canopen.Network) -> dict[int, int]:
    """How many callbacks each COB-ID has; canopen 2.3 leaves empty lists behind."""
    return {can_id: len(callbacks) for can_id, callbacks in network.subscribers.items() if callbacks}


def test_a_canopen_network_in_use_keeps_working(bus: tipforce.SimulatedBus) -> None:
    network = canopen.Network()
    network.connect(**bus.bus_options)
    notifier = network.notifier
    assert notifier is not None
    try:
        node = canopen.RemoteNode(5, canopen.ObjectDictionary())
        network.add_node(node)
        seen: list[int] = []
        network.subscribe(0x285, lambda can_id, _data, _t: seen.append(can_id))
        subscribed = callbacks_of(network)
        listeners = len(notifier.listeners)
        with tipforce.open(network) as opened:
            assert opened.finger(5).read().ok
            assert node.sdo.upload(0x1018, 4) == (1005).to_bytes(4, "little")
        assert callbacks_of(network) == subscribed
        assert len(notifier.listeners) == listeners
        assert node.sdo.upload(0x1018, 4) == (1005).to_bytes(4, "little")
        count = len(seen)
        network.sync.transmit()
        until(lambda: len(seen) > count)
    finally:
        network.disconnect()


def test_a_bus_gives_a_canopen_network(bus: tipforce.SimulatedBus) -> None:
    with tipforce.open(**bus.bus_options) as opened:
        node = opened.network.add_node(canopen.RemoteNode(5, canopen.ObjectDictionary()))
        assert opened.network is opened.network
        assert node.sdo.upload(0x1018, 4) == (1005).to_bytes(4, "little")
        assert opened.finger(5).read().ok


def test_a_finger_that_sends_no_contact_says_what_to_enable(bus: tipforce.SimulatedBus) -> None:
    sdo = bus.finger(5).sdo
    sdo["tpdo1.cob_id"] = 0xC0000185
    sdo["tpdo2.cob_id"] = 0xC0000285
    with pytest.raises(tipforce.InputError, match=r"sdo\['tpdo2.cob_id'\] = 0x40000285"):
        bus.finger(5).read()
    sdo["tpdo2.cob_id"] = 0x40000285
    assert bus.finger(5).read().ok


def test_force_or_gauges_alone_give_the_contact(bus: tipforce.SimulatedBus) -> None:
    finger = bus.finger(5)
    finger.sdo["tpdo2.cob_id"] = 0xC0000285
    assert close_to(finger.read(), LOAD)  # from the gauges, by the node's calibration
    finger.close()
    finger.sdo["tpdo3.cob_id"] = 0x40000385
    assert close_to(finger.read(), LOAD)  # from F1, F2, F3
