"""Decoders of the contact PDO on the same frames: tipforce, a loop with struct, cantools, canopen."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from tipforce.dictionary.signals import Message, tpdo_messages
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.frames.frame_array import FrameArray, frame_array
from tipforce_lab.report.study import Effort, Need, Point, Series, Study, timed

NODE_ID, GAUGES, UNKNOWN = 5, 3, -0x8000
MEASURED = ("P", "phi", "theta")
BATCHES = (1, 10, 100, 1000, 10_000)
OURS, BY_HAND, CANTOOLS, CANOPEN = "tipforce, frames at once", "struct, by hand", "cantools", "canopen PDO variables"
_AT_A_TIME = 1000  # frames per timed call of the others
STEPS = len(BATCHES) + 3

Value = float | None
"""None: the decoder reports the value as unknown."""
Rows = list[tuple[Value, ...]]
"""P, phi, theta of each frame."""


@dataclass(frozen=True, slots=True)
class _Result:
    error: float
    """Largest |value - raw x resolution| over the values that are known, in steps of the resolution."""
    unknown_shown: int
    """Number of unknown values decoded as numbers."""


def studies(effort: Effort, advance: Callable[[], None]) -> list[Study]:
    """Return one study: all decoders on every frame."""
    message = next(m for m in tpdo_messages(GAUGES) if m.name == "Contact")
    data = _frames(np.random.default_rng([effort.seed, 2]), BATCHES[-1])
    exact = [struct.unpack_from("<hhh", one) for one in data]
    results, series = {}, []
    frames = frame_array((k, message.cob_id_base + NODE_ID, one) for k, one in enumerate(data))
    results[OURS] = _judge(_ours(frames), exact, message)
    points = []
    for size in BATCHES:
        batch, decoder = frames[:size], Decoder(GAUGES, [NODE_ID])
        timing = timed(lambda batch=batch, decoder=decoder: decoder.decode(batch), effort, units=size)  # type: ignore[misc]
        points.append(Point(f"{size} frames a call", results[OURS].error, timing))
        advance()
    series.append(Series(OURS, tuple(points)))
    for method, decode in _others(message).items():
        rows = [decode(one) for one in data]
        results[method] = _judge([tuple(_known(row[name]) for name in MEASURED) for row in rows], exact, message)
        some = data[:_AT_A_TIME]

        def work(decode: Callable[[bytes], dict[str, Any]] = decode, some: list[bytes] = some) -> None:
            for one in some:
                decode(one)

        timing = timed(work, effort, units=len(some))
        series.append(Series(method, (Point("a frame a call", results[method].error, timing),)))
        advance()
    return [_study(series, results, len(data))]


def _frames(rng: np.random.Generator, count: int) -> list[bytes]:
    """Return contact PDOs with uniform raw values, one in fifty of each signal unknown."""
    limits = np.array([0x7FFF, 18000, 18000])
    raw = rng.integers(-limits, limits, size=(count, 3), endpoint=True)
    raw[rng.random(raw.shape) < 0.02] = UNKNOWN
    status = rng.integers(0, 256, count)
    return [struct.pack("<hhhBB", *row, flags, k & 0xFF) for k, (row, flags) in enumerate(
        zip(raw.tolist(), status.tolist(), strict=True))]  # fmt: skip


def _judge(rows: Rows, exact: list[tuple[int, ...]], message: Message) -> _Result:
    """Compare with raw / divisor as a fraction, the definition of the resolution of 0.001 N and 0.01 degree."""
    divisors = [round(1 / signal.scale) for signal in message.signals[: len(MEASURED)]]
    worst, shown = Fraction(0), 0
    for row, raws in zip(rows, exact, strict=True):
        for value, raw, divisor in zip(row, raws, divisors, strict=True):
            if raw == UNKNOWN:
                shown += value is not None
            else:
                assert value is not None
                worst = max(worst, abs(Fraction(value) * divisor - raw))
    return _Result(float(worst), shown)


def _ours(frames: FrameArray) -> Rows:
    (samples,) = Decoder(GAUGES, [NODE_ID]).decode(frames).values()
    columns = [samples.columns[name].tolist() for name in MEASURED]
    return [tuple(_known(value) for value in row) for row in zip(*columns, strict=True)]


def _known(value: object) -> Value:
    """Normalise unknown values: cantools returns the name "unknown", others NaN, if they support it."""
    return value if isinstance(value, float) and not math.isnan(value) else None


def _others(message: Message) -> dict[str, Callable[[bytes], dict[str, Any]]]:
    """Return a function per decoder that returns all signals of one frame by name."""
    return {BY_HAND: _by_hand(message), CANTOOLS: _cantools(message), CANOPEN: _canopen(message)}


def _by_hand(message: Message) -> Callable[[bytes], dict[str, Any]]:
    """Return a decoder written with struct for the known layout."""
    flags = [(signal.name, 1 << signal.start_bit - 48) for signal in message.signals if signal.bits == 1]
    layout = struct.Struct("<hhhBB")

    def decode(data: bytes) -> dict[str, Any]:
        P, phi, theta, status, counter = layout.unpack(data)
        found = {
            "P": math.nan if P == UNKNOWN else P / 1000,
            "phi": math.nan if phi == UNKNOWN else phi / 100,
            "theta": math.nan if theta == UNKNOWN else theta / 100,
            "counter": counter,
        }
        for name, bit in flags:
            found[name] = status & bit != 0
        return found

    return decode


def _cantools(message: Message) -> Callable[[bytes], dict[str, Any]]:
    """Return a decoder of cantools with the .dbc of `tipforce export dbc`."""
    import cantools

    from tipforce.dictionary.dbc import dbc_text

    database: Any = cantools.database.load_string(dbc_text([NODE_ID], GAUGES), "dbc")
    can_id = message.cob_id_base + NODE_ID

    def decode(data: bytes) -> dict[str, Any]:
        found: dict[str, Any] = database.decode_message(can_id, data)
        return found

    return decode


def _canopen(message: Message) -> Callable[[bytes], dict[str, Any]]:
    """Return a decoder with canopen's PDO variables; an EDS has no factors, set here, and no unknown value."""
    import io

    import canopen

    from tipforce.dictionary.eds import eds_text

    eds = io.StringIO(eds_text(GAUGES))
    eds.name = "node.eds"
    node = canopen.RemoteNode(NODE_ID, canopen.import_od(eds, NODE_ID))
    pdo = node.tpdo[message.number]
    pdo.cob_id = message.cob_id_base + NODE_ID
    pdo.clear()
    scales = {(signal.index, signal.sub): signal.scale for signal in message.signals}
    for index, sub, _bits in message.mapping:
        pdo.add_variable(index, sub).od.factor = scales[index, sub]
    P, phi, theta, status, counter = pdo.map
    flags = [(signal.name, 1 << signal.start_bit - 48) for signal in message.signals if signal.bits == 1]

    def decode(data: bytes) -> dict[str, Any]:
        pdo.on_message(pdo.cob_id, bytearray(data), 0.0)
        bits = status.raw
        found = {"P": P.phys, "phi": phi.phys, "theta": theta.phys, "counter": counter.raw}
        for name, bit in flags:
            found[name] = bits & bit != 0
        return found

    return decode


def _study(series: list[Series], results: dict[str, _Result], count: int) -> Study:
    seconds = {one.method: one.points[-1].timing.seconds for one in series}
    alone = series[0].points[0].timing.seconds
    faster = {method: f"{seconds[method] / seconds[OURS]:.0f} times" for method in (BY_HAND, CANTOOLS, CANOPEN)}
    remarks = [
        f"With {BATCHES[-1]} frames a call tipforce is {faster[BY_HAND]} as fast as the loop with struct, "
        f"{faster[CANTOOLS]} as fast as cantools and {faster[CANOPEN]} as fast as canopen.",
        f"With one frame a call it takes {alone / seconds[BY_HAND]:.0f} times as long as the loop with struct: collect "
        "frames first.",
    ]
    for method, result in results.items():
        if result.unknown_shown:
            remarks.append(f"{method}: {result.unknown_shown} unknown values (raw {UNKNOWN}) were decoded as numbers.")
    silent = [method for method, result in results.items() if not result.unknown_shown]
    remarks.append(f"Every unknown value was reported as unknown by: {', '.join(silent)}.")
    return Study(
        key="decoders",
        title="Decoders of the contact PDO",
        error_unit="largest error (steps of the signal's resolution)",
        work_unit="s per frame",
        reference=f"the raw integers as exact fractions of {count} random frames; all decoders give all signals",
        reference_error=0.0,
        series=tuple(series),
        remarks=tuple(remarks),
        needs=(Need("decode a log exactly", 1e-6, "steps", tuple(name for name in results if name not in silent)),),
    )
