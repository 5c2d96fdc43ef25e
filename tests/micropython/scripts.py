"""What conformance cases do not say to a node: loads, faults, filters, gauges by their number, and a power cycle."""

from collections.abc import Callable

from canopen_device.core import codes
from micropython.recording import PAST_SMALL_INTEGERS_US, Recording, Talk
from tipforce.dictionary import table


def calibration() -> list[Recording]:
    """Stored, restored and reset: what a power cycle finds, and a damaged store."""
    talk = Talk("calibration")
    talk.calibrate()
    record = talk.upload(0x2140)
    assert isinstance(record, bytes)
    assert talk.put("H", 0x1017, 0, 250) == 0
    assert talk.put("f", 0x6133, 7, 0.25) == 0
    assert talk.put("I", 0x1010, 1, codes.SIGNATURE_SAVE) == 0
    talk.send("000#8105")
    assert talk.upload(0x2140) == record
    second = Talk("calibration, power cycle", store=talk.recorded.stored())
    assert second.upload(0x2140) == record
    assert second.get("H", 0x1017) == 250
    assert second.put("I", 0x1011, 2, codes.SIGNATURE_LOAD) == 0
    assert second.put("I", 0x1011, 4, codes.SIGNATURE_LOAD) == 0
    second.send("000#8105")
    assert second.get("I", 0x2103, 3) == 0
    damaged = {name: content[:-2] + "00" for name, content in talk.recorded.stored().items()}
    third = Talk("calibration, store damaged", store=damaged | {"calibration": "0102"})
    third.start()
    third.sync(2)
    assert third.get("I", 0x1003, 1) == 0x6320
    return [talk.recording, second.recording, third.recording]


def measurement() -> list[Recording]:
    """Loads, SYNC and TPDOs, tare and zero by SDO and RPDO, faults of the front end, EMCY and its history."""
    talk = Talk("measurement")
    talk.start()
    talk.sync(3)
    assert talk.put("I", 0x6125, 1, table.SIGNATURE_ZERO) == 0
    talk.calibrate()
    talk.load(1.0, 0.0, 0.0)
    talk.sync(3)
    assert talk.put("I", 0x6125, 1, table.SIGNATURE_ZERO) == codes.DEVICE_STATE
    for P, phi, theta in ((1, 10, 5), (0.5, -30, -20), (0.02, 0, 0), (3, 80, 85), (2, 0, 90), (300, 0, 0)):
        talk.load(P, phi, theta)
        talk.sync(3)
        for sub in (1, 2, 3):
            talk.upload(0x2107, sub)
        for index in (0x6100, 0x6130, 0x7130, 0x9130, 0x6150):
            for sub in range(1, 4 if index == 0x6100 else 10):
                talk.upload(index, sub)
    talk.load(0.0, 0.0, 0.0)
    talk.sync(2)
    assert talk.put("B", 0x1400, 2, 255) == 0
    assert talk.put("I", 0x1400, 1, 0x205) == 0
    for line in ("205#0100", "205#0200", "205#0300", "205#0400", "205#01", "205#0100"):
        talk.send(line)
        talk.sync(2)
    assert talk.put("I", 0x6139, 4, table.SIGNATURE_TARA) == 0
    talk.sync(2)
    talk.get("f", 0x2111, 1)
    talk.get("I", 0x2111, 4)
    for fault in (1, 2, 3, 4, 5, 0):
        assert talk.put("f", 0x2200, 3, 20.0) == 0
        assert talk.put("B", 0x2200, 2, 2) == 0
        assert talk.put("H", 0x2200, 1, fault) == 0
        talk.sync(40)
        talk.advance(150_000)
        talk.sync(2)
    for sub in range(9):
        talk.upload(0x1003, sub)
    assert talk.put("B", 0x1003, 0, 0) == 0
    return [talk.recording]


def bus_faults() -> list[Recording]:
    """What a controller says of the bus, and what the node says when it is back."""
    talk = Talk("bus faults")
    talk.start()
    for class_bits, detail in ((4, 1), (4, 0x30), (4, 0x40), (0x40, 0), (0x100, 0), (4, 0x08)):
        talk.step([(0x20000000 | class_bits, bytes((0, detail, 0, 0, 0, 0, 0, 0)))])
        talk.advance(400_000)  # while the bus is off: the device asks for restarts
        talk.sync(1)
    for sub in range(9):
        talk.upload(0x1003, sub)
    return [talk.recording]


def lss() -> list[Recording]:
    """A node without a node-id is given one and a bit rate, and stores them; then it boots, and once more."""
    talk = Talk("LSS", node_id=255)
    assert not talk.sent
    for request in ("0401", "1100", "1120", "13000A", "130004", "150A00", "17", "0400"):
        talk.send("7E5#" + request.ljust(16, "0"))
    talk.advance(1_200_000)
    assert talk.device.node_id == 0x20
    second = Talk("LSS, power cycle", node_id=255, store=talk.recorded.stored())
    assert second.device.node_id == 0x20
    second.advance(2_000_000)
    return [talk.recording, second.recording]


def many_gauges() -> list[Recording]:
    """Eight gauges: more objects, two more TPDOs, a longer record."""
    points = ("L", "R", "T", "U", "K_H", "S_H", "K_V", "S_V")
    talk = Talk("eight gauges", layout=points)
    talk.calibrate(points)
    talk.start()
    for k in range(20):
        talk.load(0.3 + 0.1 * k, -40.0 + 5.0 * k, 30.0 - 3.0 * k)
        talk.sync(2)
        talk.upload(0x9130, 12)
    assert talk.put("I", 0x1010, 4, codes.SIGNATURE_SAVE) == 0
    return [talk.recording]


def judged() -> list[Recording]:
    """Gauges that contradict each other, left out and not; forces and temperatures beyond the calibration."""
    found = []
    for points in (("K_H", "S_H", "U"), *(("L", "R", "T", "U", "K_H", "S_H", "K_V", "S_V")[:n] for n in (4, 5, 8))):
        talk = Talk(f"judged, {len(points)} gauges", layout=points)
        for sub, value in enumerate((2.0, 4.0, 10.0, 22.0, 0.001), 1):
            assert talk.put("f", 0x2112, sub, value) == 0
        for k in range(len(points)):
            assert talk.put("f", 0x2113, 1 + k, 2.5e-3) == 0
            assert talk.put("f", 0x2114, 1 + k, 1e-6 * k) == 0
        assert talk.put("f", 0x2115, 0, -3e-4) == 0
        assert talk.put("f", 0x2116, 0, 30.0) == 0
        talk.calibrate(points)
        assert talk.put("I", 0x1803, 1, 0x40000485) == 0  # 2124h and u(P) at each change
        talk.start()
        for load in ((1.0, 10.0, 5.0), (2.5, 10.0, 5.0), (4.2, 10.0, 5.0), (3.9, 10.0, 5.0), (1.0, 170.0, 185.0)):
            talk.load(*load)
            talk.sync(3)
        for gauge in range(1, len(points) + 1):
            talk.get("H", 0x2124)
            assert talk.put("f", 0x2200, 3, 500.0) == 0  # microstrain/s
            assert talk.put("B", 0x2200, 2, gauge) == 0
            assert talk.put("H", 0x2200, 1, 5) == 0
            talk.sync(30, 2000)
            for sub in range(1, 4):
                talk.get("f", 0x2107, sub)
            for fault in (1, 2, 3, 0):
                assert talk.put("H", 0x2200, 1, fault) == 0
                talk.sync(3)
            talk.advance(150_000)
        found.append(talk.recording)
    return found


def filters() -> list[Recording]:
    """Each filter with extreme constants, under loads, saturation, silence and time asleep; stored, found again."""
    found = []
    for kind, constant in ((1, 7), (1, 256), (2, 5), (100, 3), (100, 65535)):
        talk = Talk(f"filter {kind}, {constant}", now_us=PAST_SMALL_INTEGERS_US if constant == 7 else 0)
        talk.calibrate()
        talk.start()
        assert talk.put("H", 0x61A1, 1, constant) == talk.put("B", 0x61A0, 1, kind) == 0
        for k in range(8):
            talk.load(0.1 * k, -30.0 + k, 10.0)
            talk.sync(4)
            if k in (3, 5):
                assert talk.put("H", 0x2200, 1, k) == 0  # saturated, then drifting
                talk.sync(3, 1700)
                assert talk.put("H", 0x2200, 1, 0) == 0
        talk.sleep(90_000)
        talk.sync(1)
        talk.upload(0x6130, 1)
        assert talk.put("I", 0x1010, 3, codes.SIGNATURE_SAVE) == 0
        second = Talk(f"filter {kind}, {constant}, power cycle", store=talk.recorded.stored())
        assert second.get("B", 0x61A0, 2) == kind
        second.start()
        second.sync(5)
        found += [talk.recording, second.recording]
    return found


def front_ends() -> list[Recording]:
    """24 bits behind a quarter bridge that warms up, and 16 bits behind an amplifier of its own."""
    found = []
    for named in (
        {"bridge": "quarter", "bits": 24, "temperature": [[0, 20], [0.0625, 40]], "apparent_strain": 1.5},
        {"bridge": "half", "gain": 128, "temperature": 30, "gain_drift_ppm": 64},
    ):
        talk = Talk(f"front end {named['bridge']}", front_end=named)
        talk.calibrate()
        talk.start()
        for k in range(20):
            talk.load(0.5 * k, -30.0 + 3.0 * k, 10.0)
            talk.sync(2)
            for index in (0x6100, 0x7100, 0x9100, 0x6122, 0x2122):
                talk.upload(index, 0 if index == 0x2122 else 1)
        found.append(talk.recording)
    return found


SCRIPTS: tuple[Callable[[], list[Recording]], ...] = (
    calibration, measurement, bus_faults, lss, many_gauges, judged, filters, front_ends,
)  # fmt: skip
