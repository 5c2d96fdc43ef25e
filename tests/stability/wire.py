"""Extreme frames and values on the wire: REAL32 at its limits, integer overflow, frames of wrong length."""

import math
import struct
import warnings

import numpy as np

from canopen_device.core import codes, communication, emcy
from fingertip import finger as rig
from stability.case import Observed, refusal
from tipforce.dictionary import indices, table
from tipforce.dictionary.names import entries
from tipforce.dictionary.signals import tpdo_messages
from tipforce.host.decoding import decoder as decode
from tipforce.host.frames.frame_array import FrameArray, frame_array

_FREE_COB_ID = codes.TIME_COB_ID + 35  # not used by any service
_RPDO_COB_ID = codes.RPDO_BASES[0] + rig.NODE_ID
_GAUGES_COB_ID, _CONTACT_COB_ID, _FORCE_COB_ID = (base + rig.NODE_ID for base in codes.TPDO_BASES[:3])
_WATCHED = 0x60  # a node-id
_IDENTIFIERS = (
    codes.NMT_COB_ID, codes.SDO_REQUEST_BASE + rig.NODE_ID, codes.LSS_REQUEST_COB_ID, codes.TIME_COB_ID,
    codes.HEARTBEAT_BASE + _WATCHED, _RPDO_COB_ID,
)  # fmt: skip
_STAGED = (
    indices.CALIBRATION_MATRIX, indices.CALIBRATION_OFFSET, indices.CALIBRATION_FACTS, indices.CALIBRATION_NOISE,
    indices.CONTACT_SETTINGS, indices.CALIBRATION_VALIDITY, indices.CALIBRATION_CONVERTER_LIMIT,
    indices.CALIBRATION_OFFSET_TEMPERATURE, indices.CALIBRATION_GAIN_TEMPERATURE, indices.CALIBRATION_REDUNDANCY_LIMIT,
)  # fmt: skip


def wire_real32_not_finite() -> Observed:
    """NaN and both infinities by SDO to every REAL32 setting of the node -> refused: 06090030h for each (staged
    calibration values aside), and the setting stays"""
    finger = rig.finger()
    tried = refused = 0
    for (index, sub), row in entries(3, True).items():
        if row.type != "f" or row.access != "rw" or index in _STAGED:
            continue
        before = finger.upload(index, sub)
        for value in (math.nan, math.inf, -math.inf):
            tried += 1
            abort = finger.put("f", index, sub, value)
            refused += abort != 0 and finger.upload(index, sub) == before
            if abort and abort not in (codes.INVALID_VALUE, codes.DEVICE_STATE):
                return False, f"{index:04X}h:{sub}: {abort:08X}h"
    return tried == refused and tried > 100, f"{refused} of {tried} writes refused"


def wire_real32_denormal() -> Observed:
    """every power of 2 from 2^-149 to 2^-126 by SDO, and back -> pass: settings keep denormals bit for bit"""
    finger = rig.finger()
    kept = 0
    for power in range(-149, -125):
        data = struct.pack("<f", 2.0**power)
        index = indices.INTERRUPT_DELTA
        kept += finger.download(index, 1, data) == 0 and finger.upload(index, 1) == data
    return kept == 24, f"{kept} of 24 kept"


def _forms(finger: rig.Finger, sub: int) -> tuple[float, float, float, int]:
    """Return a channel as 6130h, 7130h and 9130h, and its 6150h."""
    kinds = (("f", 0), ("h", table.INT16_FORM), ("i", table.INT32_FORM))
    real, short, long = (finger.get(kind, indices.PROCESS_VALUE + form, sub) for kind, form in kinds)
    return real, short, long, int(finger.get("B", indices.CHANNEL_STATUS, sub))


def wire_real32_overflow() -> Observed:
    """a process value of 3.4e42: beyond REAL32, gauge offset 3.4e38 times C -> flagged: 6130h is infinite, INTEGER16
    and INTEGER32 are at their limits, 6150h is 03h"""
    finger = rig.finger()
    taken = finger.put("f", indices.SPAN_END, 1, 3.4e38) == finger.put("f", indices.PROCESS_OFFSET, 1, 3.4e38) == 0
    finger.sync()
    strain, F1 = finger.get("f", indices.PROCESS_VALUE, 1), finger.get("f", indices.PROCESS_VALUE, 4)
    big = rig.finger(calibrated=rig.record(C=[[9e6 if i == k else 0.0 for k in range(3)] for i in range(3)]))
    big.put("f", indices.SPAN_END, 1, 3.4e38)
    big.put("f", indices.PROCESS_OFFSET, 1, 3.4e38)
    big.sync()
    forms = _forms(big, 4)
    held = taken and strain == struct.unpack("<f", struct.pack("<f", 3.4e38))[0] and math.isfinite(F1)
    held &= forms == (math.inf, 32767, 0x7FFFFFFF, 3)
    return held, f"F1 in the three forms {forms[:3]}, 6150h {forms[3]:02d}h"


def wire_integer16_overflow() -> Observed:
    """33 to 45 N on a node with gauges of a fifth of the usual strain -> flagged: 7130h reads 32767 with 6150h 03h
    (-32767, 05h); 9130h and 6130h still have the value"""
    finger = rig.finger(calibrated=rig.record(C=[[5e4 if i == k else 0.0 for k in range(3)] for i in range(3)]))
    held, seen = True, []
    for F1 in (32.766, 33.0, 45.0, -32.766, -33.0, -45.0):
        finger.source.forces = lambda _now, F1=F1: (0.2 * F1, 0.0, -0.2)
        finger.sync()
        exact, short, long, status = _forms(finger, 4)
        inside = abs(exact) <= 32.767
        held &= abs(exact - F1) < 5e-3 and abs(long - 1000.0 * exact) <= 0.51
        held &= short == (round(long) if inside else math.copysign(32767, F1))
        held &= status == (0 if inside else 3 if F1 > 0 else 5)
        seen.append(f"{exact:g} N: {short:g}/{status}")
    return held, "; ".join(seen)


def _frames(message_number: int, payloads: list[bytes]) -> tuple[FrameArray, str]:
    message = tpdo_messages(3)[message_number]
    return frame_array((k, message.cob_id_base + rig.NODE_ID, data) for k, data in enumerate(payloads)), message.name


def wire_unknown() -> Observed:
    """-32768, -32767, 0 and 32767 in every measured signal of every TPDO -> flagged: the decoder gives NaN for -32768
    and for nothing else"""
    checked, wrong = 0, 0
    for number, message in enumerate(tpdo_messages(3)):
        for signal in message.signals:
            if signal.unknown is None or not signal.signed:
                continue
            raws = [-32768, -32767, 0, 32767]
            payloads = [((raw & 0xFFFF) << signal.start_bit).to_bytes(8, "little") for raw in raws]
            frames, name = _frames(number, payloads)
            checked += 1
            found = decode.Decoder().decode(frames)[rig.NODE_ID, name]
            wrong += np.isnan(found.columns[signal.name]).tolist() != [True, False, False, False]
    return checked >= 9 and wrong == 0, f"{checked} signals, {wrong} wrong"


def wire_real32_nan_pdo() -> Observed:
    """a PDO with 6130h remapped, carrying quiet, signalling NaN and infinities -> flagged: NaN stays NaN, infinities
    stay, no warning, the counter of that PDO is right"""
    decoder = decode.Decoder()
    decoder.remap(rig.NODE_ID, "Force", _FORCE_COB_ID, [(indices.PROCESS_VALUE, 4, 32), (indices.COUNTER, 0, 8)])
    bits = (0x7FC00000, 0x7F800001, 0xFF800001, 0x7F800000, 0xFF800000, 0x00000001, 0x3F800000)
    payloads = [struct.pack("<IB", word, 200 + k) for k, word in enumerate(bits)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = decoder.decode(frame_array((k, _FORCE_COB_ID, data) for k, data in enumerate(payloads)))
    columns = found[rig.NODE_ID, "Force"].columns
    values, counters = columns["F1"].tolist(), columns["counter"].tolist()
    held = all(map(math.isnan, values[:3])) and values[3:] == [math.inf, -math.inf, 2.0**-149, 1.0]
    return held and counters == list(range(200, 207)), f"{values}"


def wire_short_pdo() -> Observed:
    """TPDOs of every length below their mapping, down to 0 bytes -> flagged: none is decoded, each is counted as
    malformed; of a longer one the first bytes are decoded"""
    right, total = 0, 0
    for number, message in enumerate(tpdo_messages(3)):
        frames, name = _frames(number, [bytes(length) for length in range(message.length_bytes)])
        total += 1
        decoder = decode.Decoder()
        none = not decoder.decode(frames)
        right += none and decoder.malformed == {(rig.NODE_ID, name): message.length_bytes}
    decoder = decode.Decoder()
    decoder.remap(rig.NODE_ID, "Contact", _CONTACT_COB_ID, [(indices.PROCESS_VALUE + table.INT16_FORM, 7, 16)])
    longer = decoder.decode(frame_array([(0, _CONTACT_COB_ID, b"\xe8\x03" + bytes(6))]))[rig.NODE_ID, "Contact"]
    held = right == total and longer.columns["P"].tolist() == [1.0] and not decoder.malformed
    return held, f"{right} of {total} messages; 8 bytes for a mapping of 2: P {longer.columns['P'][0]:g} N"


def wire_short_rpdo() -> Observed:
    """a command RPDO of 0 and of 1 byte -> flagged: EMCY 8210h once, the command does not run; the next complete one
    runs and clears the error"""
    finger = rig.finger(load=rig.PUSH, emcy=True)
    finger.put("I", communication.RPDO, 1, _RPDO_COB_ID)
    finger.sync()
    finger.step([(_RPDO_COB_ID, b"")])
    finger.step([(_RPDO_COB_ID, b"\x01")])
    codes, tare = finger.emcy(), finger.get("f", indices.TARE, 3)
    finger.step([(_RPDO_COB_ID, b"\x01\x00")])
    cured, after = finger.emcy(), finger.get("f", indices.TARE, 3)
    held = codes == [emcy.PDO_LENGTH] and tare == 0.0 and cured == [0] and abs(after + 0.996) < 1e-3
    return held, f"EMCY {[f'{code:04X}h' for code in codes]}, tare {tare:g} N, then {after:.3f} N"


def wire_no_data() -> Observed:
    """frames of length 0 to every identifier that the node receives -> pass: no exception, no state or sample changes,
    the node responds to the next SYNC"""
    finger = rig.finger(load=rig.PUSH, emcy=True)
    finger.put("I", communication.RPDO, 1, _RPDO_COB_ID)
    finger.put("I", communication.CONSUMER_HEARTBEAT, 1, _WATCHED << 16 | 100)
    before, active = finger.sync(), finger.calibration()
    finger.emcy()
    answers = finger.step([(can_id, b"") for can_id in _IDENTIFIERS])
    after = finger.sync()
    held = after[:3] == before[:3] and after.counter == before.counter + 1 and finger.calibration() == active
    held &= all(can_id == codes.EMCY_BASE + rig.NODE_ID for can_id, _ in answers)  # EMCY of the RPDO's length
    return held, f"{len(_IDENTIFIERS)} identifiers, answers: {[hex(can_id) for can_id, _ in answers]}"


def wire_same_cob_id() -> Observed:
    """another node sends with this node's COB-ID; one identifier given to two messages -> flagged: the node reports
    EMCY 8150h once; the host's decoder refuses the second one"""
    finger = rig.finger(emcy=True)
    for _ in range(3):
        finger.step([(_GAUGES_COB_ID, bytes(8))])
    codes, decoder, mapped = finger.emcy(), decode.Decoder(), [(indices.PROCESS_VALUE + table.INT16_FORM, 7, 16)]
    decoder.remap(5, "Contact", _FREE_COB_ID, mapped)
    said = refusal(decoder.remap, 6, "Contact", _FREE_COB_ID, mapped)
    held = codes == [emcy.COB_ID_COLLISION] and "already assigned to Contact of node 5" in said
    return held, f"EMCY {codes[0]:04X}h; {said}"


def wire_foreign() -> Observed:
    """29-bit, remote and error frames with the bits of a PDO identifier -> pass: the decoder ignores all of them"""
    extended, remote = codes.EXTENDED_FLAG, codes.REMOTE_FLAG
    flags = (extended, remote, codes.ERROR_FLAG, extended | remote, 0x800, 0x10000)
    frames = frame_array((k, _GAUGES_COB_ID | flag, bytes(range(8))) for k, flag in enumerate(flags))
    decoder = decode.Decoder()
    found = decoder.decode(frames)
    return not found and not decoder.malformed, f"{len(flags)} kinds of frame, {len(found)} decoded"


def wire_noise() -> Observed:
    """20000 frames of random identifier, length and bytes, seeded -> pass: host and node raise nothing, the calibration
    stays, the node responds to SYNC"""
    rng = np.random.default_rng(14)
    finger = rig.finger(load=rig.PUSH)
    active = finger.calibration()
    ids, lengths = rng.integers(1, codes.STANDARD_MASK + 1, 20000), rng.integers(0, 9, 20000)
    data = rng.integers(0, 256, (20000, 8), dtype=np.uint8)
    frames = [(int(i), bytes(row[:n])) for i, n, row in zip(ids, lengths, data, strict=True)]
    frames = [frame for frame in frames if frame[0] != codes.LSS_REQUEST_COB_ID]
    for start in range(0, len(frames), 100):
        finger.now_us += 1000
        finger.step(frames[start : start + 100])
    samples = decode.Decoder().decode(frame_array((0, can_id, row) for can_id, row in frames))
    finger.nmt(codes.NMT_START)
    finger.take()
    found = finger.sync()
    held = finger.calibration() == active and found.contact[0] == 1000
    return held, f"{len(frames)} frames, {len(samples)} messages decoded, P still {found.contact[0]} mN"
