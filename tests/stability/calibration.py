"""Extreme calibrations on the node: impossible, ill-conditioned, corrupted, huge and tiny ones, and tares."""

import binascii
import math

import numpy as np

from canopen_device.core import codes, communication
from canopen_device.testing import MemoryStore
from fingertip import finger as rig
from stability.case import Observed
from tipforce.dictionary import indices, table, table_objects
from tipforce.sensor.contact import scalar

_GROUP = 4


def _refused(finger: rig.Finger, record: bytes, code: int) -> bool:
    """Check that a record is refused at commit with a code, and the active one is unchanged."""
    before = finger.calibration()
    return finger.stage(record) == 0 and finger.commit() == code and finger.calibration() == before


def calibration_staged_not_finite() -> Observed:
    """NaN or an infinity staged by SDO in every REAL32 of the record -> refused: staging is accepted, commit refuses
    with 06090030h, the active record stays"""
    finger = rig.finger(load=rig.PUSH)
    shown, count, held = finger.sync(), 0, True
    for index, sub, kind in table_objects.staged(3):
        if kind != "f":
            continue
        for value in (math.nan, math.inf, -math.inf):
            finger.stage(rig.record())
            held &= finger.put("f", index, sub, value) == 0
            held &= finger.put("I", indices.CALIBRATION_CHECK, 1, finger.get("I", indices.CALIBRATION_CHECK, 2)) == 0
            before = finger.calibration()
            held &= finger.commit() == codes.INVALID_VALUE and finger.calibration() == before
            count += 1
    after = finger.sync()
    return held and after[:3] == shown[:3], f"{count} records refused, P stays {after.contact[0]} mN"


def _conditioned(kappa: float) -> list[list[float]]:
    left, _ = np.linalg.qr(np.array([[2.0, 1.0, 0.5], [-1.0, 3.0, 1.0], [0.5, -1.0, 2.0]]))
    right, _ = np.linalg.qr(np.array([[1.0, 2.0, -1.0], [0.5, 1.0, 3.0], [2.0, -1.0, 0.3]]))
    C: list[list[float]] = (1e4 * left @ np.diag([1.0, 1.0, 1.0 / kappa]) @ right).tolist()
    return C


def calibration_condition() -> Observed:
    """C with condition numbers from 10 to 1e14, and singular; limit 1e4 -> refused: up to the limit commit accepts,
    above it refuses with 06090031h and nothing changes"""
    verdicts = []
    for kappa in (10.0, 1e3, 9.9e3, 1.01e4, 1e6):
        finger = rig.finger()
        record = rig.record(C=_conditioned(kappa))
        verdicts.append((finger.stage(record) or finger.commit()) == 0)
        if not verdicts[-1] and not _refused(finger, record, codes.TOO_HIGH):
            return False, f"condition {kappa:g}: not refused as it should be"
    # Beyond 1e7 REAL32 cannot represent a rotated matrix, but a graded one exactly.
    exact = []
    for tiny in (2.0**-20, 2.0**-46, 0.0):
        finger = rig.finger()
        refused = _refused(finger, rig.record(C=[[1e4, 0, 0], [0, 1e4, 0], [0, 0, 1e4 * tiny]]), codes.TOO_HIGH)
        exact.append(refused and finger.get("f", indices.CALIBRATION_FACTS, 5) == (1.0 / tiny if tiny else math.inf))
    held = verdicts == [True, True, True, False, False] and all(exact)
    return held, f"10, 1e3, 9.9e3, 1.01e4, 1e6: accepted {verdicts}; 1e6, 7e13, infinity: refused {exact}"


def calibration_impossible_noise() -> Observed:
    """2106h: a negative variance; correlations of 5; three of -0.9 -> refused: commit refuses with 06090030h: else u
    would be 0 and theta would count as resolved"""
    c = 1e-14
    triples = {
        "negative": (-c, 0, 0, c, 0, c),
        "negative, denormal": (c, 0, 0, c, 0, -1e-45),
        "correlation 5": (c, 5 * c, 0, c, 0, c),
        "correlation 1.1": (c, 1.1 * c, 0, c, 0, c),
        "three of -0.9": (c, -0.9 * c, -0.9 * c, c, -0.9 * c, c),
        "0 with covariance": (0, c, 0, c, 0, c),
    }
    finger = rig.finger(load=rig.PUSH)
    records = {name: rig.record(variance=noise) for name, noise in triples.items()}
    refused = {name: _refused(finger, record, codes.INVALID_VALUE) for name, record in records.items()}
    after, u_P = finger.sync(), finger.get("f", indices.UNCERTAINTY, 1)
    held = all(refused.values()) and after.contact[0] == 1000 and u_P > 0.0
    return held, f"refused: {', '.join(name for name, yes in refused.items() if yes)}; u_P stays {1e3 * u_P:g} mN"


def calibration_possible_noise() -> Observed:
    """2106h: all 0; fully correlated; variances 1e-30 to 1e-6 in one record -> pass: commit accepts each: REAL32's
    rounding does not count as impossible"""
    rng = np.random.default_rng(11)
    records = [(0.0,) * 6, (1e-14,) * 6, (1e-30, 0, 0, 1e-14, 0, 1e-6), (1e-38, 0, 0, 1e-14, 0, 1e30)]
    records += [(2e-14, -2e-14, 1e-14, 2e-14, -1e-14, 5e-15), (1e-14, -1e-14, 0, 1e-14, 0, 1e-14)]
    for rank in (1, 2, 3):
        for _ in range(20):
            B = 1e-7 * rng.standard_normal((3, rank)) * 10.0 ** rng.uniform(-3.0, 3.0, (3, 1))
            records.append(tuple((B @ B.T)[np.triu_indices(3)].tolist()))
    accepted = 0
    for noise in records:
        finger = rig.finger()
        accepted += (finger.stage(rig.record(variance=noise)) or finger.commit()) == 0
    return accepted == len(records), f"{accepted} of {len(records)} accepted, ranks 0 to 3"


def calibration_flipped_in_transit() -> Observed:
    """each of the 1264 bits of a record flipped in transit, CRC as sent -> refused: commit refuses every one with
    06040043h; the active CRC stays"""
    finger, record = rig.finger(load=rig.PUSH), rig.record(tip=(0.015, -60.0, 60.0, 0.05, 0.02, 1))
    before, crc, refused, total = finger.calibration(), binascii.crc32(record), 0, 8 * len(record)
    for bit in range(total):
        # A load sense that is neither 0 nor 1 is refused at once.
        staged = finger.stage(rig.flipped(record, bit), crc)
        refused += staged == codes.INVALID_VALUE or (staged == 0 and finger.commit() == codes.INCOMPATIBLE)
    held = refused == total == 1264 and finger.calibration() == before
    return held, f"{refused} of {total} refused, active CRC {before[1]:08X}h stays"


def _stored() -> MemoryStore:
    memory = MemoryStore()
    rig.finger(store=memory).put("I", communication.STORE_PARAMETERS, _GROUP, codes.SIGNATURE_SAVE)
    return memory


def _started(memory: MemoryStore) -> rig.Finger:
    return rig.finger(calibrated=False, load=rig.PUSH, store=memory, emcy=True)


def _uncalibrated(finger: rig.Finger) -> bool:
    codes = finger.emcy()
    found = finger.sync()
    unknown = not found.status & scalar.CALIBRATED and found.contact == rig.HUSHED
    return unknown and codes == [table.EMCY_CALIBRATION_INVALID] and finger.calibration()[1] == 0


def calibration_flipped_in_store() -> Observed:
    """each bit of a stored calibration flipped before the start -> flagged: the node starts uncalibrated (bit 1 clear,
    P unknown) with EMCY 6320h, for every one"""
    memory = _stored()
    data = memory.groups["calibration"]
    good = _started(memory).sync()
    caught, total = 0, 8 * len(data)
    for bit in range(total):
        memory.groups["calibration"] = rig.flipped(data, bit)
        if not _uncalibrated(_started(memory)):
            break
        caught += 1
    held = caught == total and good.contact[0] == 1000
    return held, f"{caught} of {total} noticed; whole, the node shows {good.contact[0]} mN"


def calibration_cut_store() -> Observed:
    """a stored calibration of every length from 0 to one byte short -> flagged: the node starts uncalibrated and never
    with a part"""
    memory = _stored()
    data, caught = memory.groups["calibration"], 0
    for length in range(1, len(data)):
        memory.groups["calibration"] = data[:length]
        caught += _uncalibrated(_started(memory))
    memory.groups["calibration"] = b""  # the state after a restore of defaults: no damage
    empty = _started(memory)
    held = caught == len(data) - 1 and not empty.emcy() and not empty.sync().status & scalar.CALIBRATED
    return held, f"{caught} of {len(data) - 1} lengths noticed; nothing stored: uncalibrated, no EMCY"


def calibration_huge() -> Observed:
    """C of 3.4e38 N per strain, the largest REAL32 -> refused: commit refuses with 06090031h; the active calibration
    stays"""
    return _sized(3.4e38, codes.TOO_HIGH)


def calibration_tiny() -> Observed:
    """C of 1e-44 N per strain, a denormal REAL32 -> refused: commit refuses with 06090032h; the active calibration
    stays"""
    return _sized(1e-44, codes.TOO_LOW)


def _sized(newtons_per_strain: float, code: int) -> Observed:
    finger = rig.finger(load=rig.PUSH)
    before = finger.calibration()
    C = [[newtons_per_strain if i == k else 0.0 for k in range(3)] for i in range(3)]
    abort = finger.stage(rig.record(C=C)) or finger.commit()
    held = abort == code and finger.calibration() == before and finger.sync().contact[0] == 1000
    return held, f"{abort:08X}h, active CRC {before[1]:08X}h stays"


def calibration_tare_huge() -> Observed:
    """a tare at 32 N, then 0.5 N less; with offsets of 3000 microstrain -> bounded: the rest is right within one count
    (1 mN); F is computed in double precision"""
    offsets = [0.0, 0.0, 3000e-6]
    finger = rig.finger(calibrated=rig.record(offsets=offsets))
    finger.source.offset_microstrain = [1e6 * offset for offset in offsets]
    worst = 0.0
    for P in (1.0, 2.0):
        finger.source.forces = lambda _now, P=P: (32.0, -32.0, P)
        finger.sync()
        held = finger.put("I", indices.AUTOTARE, 4, table.SIGNATURE_TARA) == 0
        finger.source.forces = lambda _now, P=P: (31.5003, -31.4996, P - 0.5004)
        finger.sync()
        F = [finger.get("f", indices.PROCESS_VALUE, sub) for sub in (4, 5, 6)]
        worst = max(worst, float(np.abs(np.subtract(F, (-0.4997, 0.5004, -0.5004))).max()))
    return held and worst <= 1e-3, f"F off by at most {1e3 * worst:.2g} mN after tares of 45 N"


def calibration_tare_saturated() -> Observed:
    """a tare while a gauge is saturated, or while the sample is stale -> refused: 08000022h, and the previous tare
    stays"""
    finger = rig.finger(load=rig.PUSH)
    finger.sync()
    held = finger.put("I", indices.AUTOTARE, 4, table.SIGNATURE_TARA) == 0
    before = [finger.get("f", indices.TARE, sub) for sub in (1, 2, 3)]
    finger.source.forces = lambda _now: (40.0, 0.0, 0.0)
    finger.sync()
    saturated = finger.put("I", indices.AUTOTARE, 4, table.SIGNATURE_TARA)
    finger.source.forces = None
    finger.sync()
    finger.sync(10)
    stale = finger.put("I", indices.AUTOTARE, 4, table.SIGNATURE_TARA)
    after = [finger.get("f", indices.TARE, sub) for sub in (1, 2, 3)]
    held &= saturated == stale == codes.DEVICE_STATE and before == after and any(before)
    return held, f"saturated {saturated:08X}h, stale {stale:08X}h, tare stays {before[2]:.3f} N along F3"


def calibration_scaling_points_equal() -> Observed:
    """6120h = 6122h: both scaling points at one field value -> refused: 06090030h in each of the three forms, and the
    scaling stays"""
    finger = rig.finger(load=rig.PUSH)
    before, aborts = finger.sync(), []
    for kind, form in (("f", 0), ("h", table.INT16_FORM), ("i", table.INT32_FORM)):
        aborts.append(finger.put(kind, indices.SCALING_2_FIELD + form, 1, 0))
    after = finger.sync()
    held = aborts == [codes.INVALID_VALUE] * 3 and after[:3] == before[:3]
    return held, f"{', '.join(f'{abort:08X}h' for abort in aborts)}; SG1 stays {after.gauges[0] / 10:g}"


def calibration_scaling_denormal() -> Observed:
    """6122h = 1.4e-45 counts with 6120h = 0: a gain of 2e48 -> flagged: the gauge is outside its span: 7130h at its
    limit, 6150h 03h, P unknown"""
    finger = rig.finger(load=rig.PUSH)
    taken = finger.put("f", indices.SCALING_2_FIELD, 1, 1.4e-45) == 0
    found = finger.sync()
    statuses = [finger.get("B", indices.CHANNEL_STATUS, sub) for sub in (1, 7)]
    values = [finger.get("f", indices.PROCESS_VALUE, sub) for sub in (1, 7)]
    held = taken and (found.gauges[0], found.contact[0]) == (32767, table.UNKNOWN_I16) and statuses == [3, 1]
    return held and all(map(math.isnan, values)), f"SG1 and P: {values}, 6150h {statuses}"


def calibration_locked() -> Observed:
    """staged writes and commit with the write lock 2105h:2 set -> refused: 08000022h for each, the record and its CRC
    stay"""
    finger = rig.finger()
    before = finger.calibration()
    finger.put("B", indices.CALIBRATION_GUARD, 2, 1)
    aborts = [finger.put("f", indices.CALIBRATION_MATRIX, 1, 1.0), finger.stage(rig.record(offsets=[1.0, 0.0, 0.0]))]
    aborts += [finger.commit(), finger.put("B", indices.CALIBRATION_GUARD, 2, 0)]
    held = aborts == [codes.DEVICE_STATE] * 4 and finger.calibration() == before
    return held, ", ".join(f"{abort:08X}h" for abort in aborts)
