"""Extreme times: counters and clocks that wrap, step back or stop, and sample rates that differ from that of SYNC."""

import datetime
import itertools
import struct

import numpy as np

from canopen_device.core import codes, communication
from fingertip import finger as rig
from stability.case import Observed
from tipforce.dictionary import indices
from tipforce.host.configuration.measurements import time_faults
from tipforce.host.decoding import decoder
from tipforce.host.frames.frame_array import frame_array
from tipforce.host.logs.candump import CandumpParser
from tipforce.host.logs.candump_format import CandumpFormat
from tipforce.sensor.contact import scalar
from tools.blocks import block_of_text

_GAUGES_COB_ID, _HEARTBEAT_COB_ID = codes.TPDO_BASES[0] + rig.NODE_ID, codes.HEARTBEAT_BASE + rig.NODE_ID
_DAY_MS = 86_400_000
_NO_SYNC_US = 1_200_000  # the node latches by itself again


def clock_counter_wrap() -> Observed:
    """the 8-bit sample counter over 1000 SYNCs, 40 frames lost in 5 gaps -> pass: unwrapped it counts every sample;
    lost_samples() returns 40"""
    finger = rig.finger(load=rig.PUSH)
    counters = [finger.sync().counter for _ in range(1000)]
    kept = [c for k, c in enumerate(counters) if not any(start <= k < start + 8 for start in range(100, 1000, 200))]
    whole, lost = decoder.unwrap_counter(counters), decoder.lost_samples(kept)
    right = np.array_equal(whole, counters[0] + np.arange(1000))
    span = int(decoder.unwrap_counter(kept)[-1]) - counters[0]
    return right and lost == 40 and span == 999, f"{len(counters)} samples to {whole[-1]}, {lost} lost"


def clock_counter_full_turn() -> Observed:
    """255 and 256 frames lost in a row: a turn of the 8-bit counter -> bounded: NOT visible in the counter; visible in
    the receive times; up to 254 in a row are counted"""
    said, gaps = [], []
    for lost in (253, 254, 255, 256, 257):
        kept = [k for k in range(600) if not 10 <= k < 10 + lost]
        frames = [(10**6 * k, _GAUGES_COB_ID, bytes(7) + bytes((k & 0xFF,))) for k in kept]
        found = decoder.Decoder().decode(frame_array(frames))[rig.NODE_ID, "Gauges"]
        said.append(decoder.lost_samples(found.columns["counter"]))
        gaps.append(int(np.diff(found.t_ns).max()) // 10**6 - 1)
    held = said == [253, 254, 0, 0, 1] and gaps == [253, 254, 255, 256, 257]
    return held, f"lost {gaps} by the times, {said} by the counter"


def clock_microseconds_wrap() -> Observed:
    """1013h, the 32-bit microseconds of CiA 301, written as 0xFFFFFFFF -> pass: 1 us later it reads 0, after 2^32 us
    the same again"""
    finger = rig.finger()
    finger.put("I", communication.HIGH_RESOLUTION_TIME, 0, 0xFFFFFFFF)
    seen = []
    for after in (0, 1, 2**32 - 2, 1, 1):
        finger.now_us += after
        finger.step()
        seen.append(int(finger.get("I", communication.HIGH_RESOLUTION_TIME)))
    return seen == [0xFFFFFFFF, 0, 0xFFFFFFFE, 0xFFFFFFFF, 0], f"{[hex(value) for value in seen]}"


def clock_long_run() -> Observed:
    """the node's clock at and near 2^31, 2^32, 2^53 us (285 years) -> pass: the node responds to SYNC, the heartbeat
    keeps its period, nothing wraps"""
    held, beats = True, []
    for turn in (2**31, 2**32, 2**53):
        finger = rig.finger(load=rig.PUSH)
        finger.now_us = turn - 50_000
        finger.step()
        finger.put("H", communication.PRODUCER_HEARTBEAT, 0, 10)
        for _ in range(100):
            finger.now_us += 1000
            finger.step()
        times = sum(can_id == _HEARTBEAT_COB_ID for can_id, _ in finger.sent)
        beats.append(times)
        found = finger.sync()
        held &= times == 10 and found.contact[0] == 1000 and not found.status & scalar.STALE
    return held, f"heartbeats in 100 ms at 10 ms: {beats}"


def _time(when: datetime.datetime) -> bytes:
    since = when - datetime.datetime(1984, 1, 1)
    return struct.pack("<IH", (since.seconds * 1000) + since.microseconds // 1000, since.days)


def clock_time_of_day() -> Observed:
    """TIME for 2038-01-19, 2106-02-07 and the last day of 16 bits, 2163-06-06 -> pass: network time in milliseconds
    equals the calendar's, and continues over the wrap"""
    epoch, off = datetime.datetime(1970, 1, 1), []
    for when in (datetime.datetime(2038, 1, 19, 3, 14, 7), datetime.datetime(2106, 2, 7, 6, 28, 15),
                 datetime.datetime(2163, 6, 6, 23, 59, 59)):  # fmt: skip
        finger = rig.finger()
        finger.step([(codes.TIME_COB_ID, _time(when))])
        finger.now_us += 2_000_000
        finger.step()
        right = (when + datetime.timedelta(seconds=2) - epoch) // datetime.timedelta(milliseconds=1)
        off.append(finger.device.time.unix_ms() - right)
    last = (datetime.datetime(2163, 6, 6) - datetime.datetime(1984, 1, 1)).days
    return off == [0, 0, 0] and last == 0xFFFF, f"off by {off} ms, 2 s after each; last day is {last}"


def clock_time_of_day_impossible() -> Observed:
    """TIME with 86400000 ms or more after midnight, or 5 and 7 bytes -> refused: the message is discarded, the previous
    time continues"""
    finger = rig.finger()
    never = finger.device.time.unix_ms()
    finger.step([(codes.TIME_COB_ID, _time(datetime.datetime(2024, 2, 29, 12)))])
    before = finger.device.time.unix_ms()
    for data in (struct.pack("<IH", _DAY_MS, 40), struct.pack("<IH", 0x0FFFFFFF, 40), bytes(5), bytes(7), b""):
        finger.now_us += 1_000_000
        finger.step([(codes.TIME_COB_ID, data)])
    after = finger.device.time.unix_ms()
    return never is None and after - before == 5000, f"5 messages passed over; time runs on by {after - before} ms"


def clock_log_2038() -> Observed:
    """candump stamps 2^31 - 1, 2^31, 2^32 and 9223372035 s (2262) -> pass: read to the nanosecond; lines written and
    read again are equal"""
    stamps = ["2147483647.999999", "2147483648.000000", "4294967296.000001", "9223372035.854775"]
    lines = [f"({stamp}) can0 185#0102030405060708" for stamp in stamps]
    block = block_of_text("\n".join(lines))
    right = [int(stamp.replace(".", "")) * 1000 for stamp in stamps]
    again = CandumpFormat("a", log=True).lines(block)
    held = block.frames["t_ns"].tolist() == right and again == lines
    return held, f"{len(lines)} lines, last {again[-1].split()[0]}"


def clock_log_beyond() -> Observed:
    """candump stamps of 9223372037 s, 11 digits, -1, NaN, 1e9, and dates of 9999 -> refused: each is a bad line with
    its number and reason; the good ones around it count"""
    bad = ["9223372037.000000", "10000000000.000000", "-1.000000", "nan", "1e9", "9999-12-31 23:59:59.000000",
           "2147483648"]  # fmt: skip
    parser = CandumpParser()
    lines = [f"({stamp}) can0 185#01" for stamp in ["1.000000", *bad, "2.000000"]]
    block = block_of_text("\n".join(lines), parser)
    numbers = [number for number, line in enumerate(lines, 1) if CandumpParser().frame(line) is None]
    counts = parser.notes.bad
    held = block.frames["t_ns"].tolist() == [10**9, 2 * 10**9] and counts == {"timestamp": len(bad)}
    return held and numbers == list(range(2, 2 + len(bad))), f"bad lines {numbers}: {counts}"


def clock_log_backwards() -> Observed:
    """a log whose clock falls by 1 hour in the middle -> pass: frames keep their order and timestamps; the counter
    shows no loss"""
    t_ns = np.concatenate((np.arange(500), np.arange(500) - 3600 * 1000)) * 10**6 + 10**18
    counters = np.arange(1000) % 256
    rows = [(int(t), _GAUGES_COB_ID, bytes(7) + bytes((int(c),))) for t, c in zip(t_ns, counters, strict=True)]
    found = decoder.Decoder().decode(frame_array(rows))[rig.NODE_ID, "Gauges"]
    held = np.array_equal(found.t_ns, t_ns) and np.array_equal(found.columns["counter"], counters)
    lost = decoder.lost_samples(found.columns["counter"])
    falls = int((np.diff(found.t_ns) < 0).sum())
    return held and lost == 0 and falls == 1, f"1000 samples in order, {falls} fall of the clock kept, {lost} lost"


def clock_rows_backwards() -> Observed:
    """measurement rows with one jump back of 10 s in 100 -> refused: the fewest rows that restore the order are bad,
    each with the reason"""
    t_s = np.arange(100.0)
    t_s[60:64] -= 10.0
    faults = time_faults(list(range(2, 102)), t_s.tolist())
    lines = [line for line, _ in faults]
    held = lines == [62, 63, 64, 65] and all(reason for _, reason in faults)
    return held, f"lines {lines}: {faults[0][1]}" if faults else "nothing found"


def clock_live_backwards() -> Observed:
    """the node's clock falls by 10 s, with and without SYNC; then by 1 us, 1000 times -> pass: values stay live: the
    next read shows the new load; heartbeats continue within a period"""
    finger = rig.finger(load=rig.PUSH)
    finger.put("H", communication.PRODUCER_HEARTBEAT, 0, 100)
    finger.sync()
    finger.source.load = (2.0, *rig.PUSH[1:])
    finger.now_us += _NO_SYNC_US
    shown = [finger.get("f", indices.PROCESS_VALUE, 7)]
    finger.now_us -= 10_000_000
    finger.source.load = (3.0, *rig.PUSH[1:])
    finger.step()
    finger.take()
    due = finger.due_us - finger.now_us
    finger.now_us += _NO_SYNC_US
    shown.append(finger.get("f", indices.PROCESS_VALUE, 7))
    beats = sum(can_id == _HEARTBEAT_COB_ID for can_id, _ in finger.sent)
    finger.source.load = (4.0, *rig.PUSH[1:])
    shown.append(finger.sync().contact[0] * 1e-3)
    for _ in range(1000):
        finger.now_us -= 1
        finger.step()
    finger.source.load = (5.0, *rig.PUSH[1:])
    shown.append(finger.sync().contact[0] * 1e-3)
    held = [round(P) for P in shown] == [2, 3, 4, 5] and beats >= 1 and 0 < due <= 100_000
    return held, f"P {', '.join(f'{P:.3f}' for P in shown)} N; next due in {due / 1000:g} ms, {beats} heartbeats"


def clock_slept() -> Observed:
    """the node's process sleeps for an hour in OPERATIONAL -> pass: one heartbeat, no burst; the next read shows the
    present load"""
    finger = rig.finger(load=rig.PUSH)
    finger.put("H", communication.PRODUCER_HEARTBEAT, 0, 100)
    finger.sync()
    finger.source.load = (2.0, *rig.PUSH[1:])
    finger.take()
    finger.now_us += 3_600_000_000
    finger.step()
    sent, P = list(finger.sent), finger.get("f", indices.PROCESS_VALUE, 7)
    again = finger.due_us - finger.now_us
    held = [can_id for can_id, _ in sent] == [_HEARTBEAT_COB_ID] and abs(P - 2.0) < 1e-3 and 0 < again <= 100_000
    return held, f"{len(sent)} frame sent on waking, P {P:.3f} N, next due in {again / 1000:g} ms"


def clock_sync_twice_rate() -> Observed:
    """SYNC at twice the rate of the converter (250 us against 500 us) -> flagged: every second PDO pair has bit 3, all
    unknown, and repeats the counter; the others are right"""
    finger = rig.finger(load=rig.PUSH)
    finger.sync()
    found = [finger.sync(250) for _ in range(200)]
    stale = [bool(one.status & scalar.STALE) for one in found]
    hushed = all((one.contact == one.gauges == rig.HUSHED) == old for one, old in zip(found, stale, strict=True))
    right = all(one.contact[0] == 1000 for one, old in zip(found, stale, strict=True) if not old)
    counts = decoder.unwrap_counter([one.counter for one in found])
    repeats = (np.diff(counts) == 0).tolist() == stale[1:]
    alternate = all(one != other for one, other in itertools.pairwise(stale))
    held = hushed and right and repeats and alternate
    return held, f"{sum(stale)} of 200 stale, counter advances by {counts[-1] - counts[0]}"


def clock_sync_burst() -> Observed:
    """100 SYNCs within one microsecond -> flagged: one sample; 99 responses have bit 3 and its counter, none shows a
    value"""
    finger = rig.finger(load=rig.PUSH)
    finger.sync()
    found = [finger.sync(1000 if k == 0 else 0) for k in range(100)]
    stale = [bool(one.status & scalar.STALE) for one in found]
    held = stale == [False] + [True] * 99 and len({one.counter for one in found}) == 1
    held &= all(one.contact == rig.HUSHED for one in found[1:]) and found[0].contact[0] == 1000
    return held, f"{sum(stale)} of 100 stale, counter {found[0].counter} in all"


def clock_sample_period() -> Observed:
    """6114h = 0, 1, 99, 1000001, 2^32 - 1 us; then 1 s -> refused: 06090032h or 06090031h, the period stays; at 1 s
    every SYNC in between has bit 3"""
    finger = rig.finger(load=rig.PUSH)
    aborts = [finger.put("I", indices.SAMPLE_PERIOD_US, 1, value) for value in (0, 1, 99, 1_000_001, 2**32 - 1)]
    kept = finger.get("I", indices.SAMPLE_PERIOD_US, 1)
    held = aborts == [codes.TOO_LOW] * 3 + [codes.TOO_HIGH] * 2 and kept == 500 and finger.source.period_us == 500
    held &= finger.put("I", indices.SAMPLE_PERIOD_US, 1, 1_000_000) == 0
    finger.now_us = 5_000_500
    finger.sync(0)
    found = [finger.sync(100_000) for _ in range(30)]
    fresh = [k for k, one in enumerate(found) if not one.status & scalar.STALE]
    held &= fresh == [9, 19, 29] and all((one.contact == rig.HUSHED) == (k not in fresh) for k, one in enumerate(found))
    faults = sum(bool(one.status & scalar.FRONT_END_FAULT) for one in found)
    return held and faults == 0, f"5 refused; at 1 s {len(fresh)} of 30 SYNCs at 100 ms have news, no fault claimed"
