"""Decoders of the contact PDO on the same frames: tipforce, a loop with struct, cantools, canopen."""

import math
import struct
from collections.abc import Callable
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np

from tipforce.dictionary.signals import Message, tpdo_messages
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.frames.frame_array import frame_array
from tipforce_lab.report.study import Effort, Need, Point, Series, Study, timed

NODE_ID, GAUGES, UNKNOWN = 5, 3, -0x8000
MEASURED = ("P", "phi", "theta")
BATCHES = (1, 10, 100, 1000, 10_000)
OURS, BY_HAND, CANTOOLS, CANOPEN = "tipforce, frames at once", "struct, by hand", "cantools", "canopen PDO variables"
_AT_A_TIME = 1000  # frames per timed call of the others
STEPS = len(BATCHES) + 3

Decode = Callable[[bytes], dict[str, Any]]
"""One frame -> all signals by name."""
Rows = list[tuple[float | None, ...]]
"""P, phi, theta of each frame; None: the decoder reports the value as unknown."""


def studies(effort: Effort, advance: Callable[[], None]) -> list[Study]:
    """Return one study: all decoders on every frame."""
    message = next(m for m in tpdo_messages(GAUGES) if m.name == "Contact")
    data = _frames(np.random.default_rng([effort.seed, 2]), BATCHES[-1])
    frames = frame_array((k, message.cob_id_base + NODE_ID, frame) for k, frame in enumerate(data))
    (samples,) = Decoder(GAUGES, [NODE_ID]).decode(frames).values()
    columns = [map(_known, samples.columns[name].tolist()) for name in MEASURED]
    error, shown = judge(list(zip(*columns, strict=True)), data, message)
    unknown_shown, points = {OURS: shown}, []
    for size in BATCHES:
        batch, decoder = frames[:size], Decoder(GAUGES, [NODE_ID])
        timing = timed(partial(decoder.decode, batch), effort, units=size)
        points.append(Point(f"{size} frames a call", error, timing))
        advance()
    series, some = [Series(OURS, tuple(points))], data[:_AT_A_TIME]
    for method, decode in others(message).items():
        rows = [decode(frame) for frame in data]
        values = [tuple(_known(row[name]) for name in MEASURED) for row in rows]
        error, unknown_shown[method] = judge(values, data, message)
        timing = timed(lambda one=decode: list(map(one, some)), effort, units=len(some))  # type: ignore[misc]
        series.append(Series(method, (Point("a frame a call", error, timing),)))
        advance()
    return [_study(series, unknown_shown, len(data))]


def _frames(rng: np.random.Generator, count: int) -> list[bytes]:
    limits = np.array([0x7FFF, 18000, 18000])
    raw = rng.integers(-limits, limits, size=(count, 3), endpoint=True)
    raw[rng.random(raw.shape) < 0.02] = UNKNOWN
    status = rng.integers(0, 256, count)
    rows = zip(raw.tolist(), status.tolist(), strict=True)
    return [struct.pack("<hhhBB", *row, flags, k & 0xFF) for k, (row, flags) in enumerate(rows)]


def judge(rows: Rows, data: list[bytes], message: Message) -> tuple[float, int]:
    """Return the largest error in steps of the resolution, and the number of unknown values decoded as numbers."""
    divisors = [round(1 / signal.scale) for signal in message.signals[: len(MEASURED)]]
    worst, shown = Fraction(0), 0
    for row, frame in zip(rows, data, strict=True):
        for value, raw, divisor in zip(row, struct.unpack_from("<hhh", frame), divisors, strict=True):
            if raw == UNKNOWN:
                shown += value is not None
            else:
                assert value is not None
                worst = max(worst, abs(Fraction(value) * divisor - raw))
    return float(worst), shown


def _known(value: object) -> float | None:
    """Normalise unknown values: cantools returns the name "unknown", others NaN, if they support it."""
    return value if isinstance(value, float) and not math.isnan(value) else None


def others(message: Message) -> dict[str, Decode]:
    """Return the decoders of one frame; that of cantools has the .dbc of `tipforce export dbc`."""
    import cantools

    from tipforce.dictionary.dbc import dbc_text

    database: Any = cantools.database.load_string(dbc_text([NODE_ID], GAUGES), "dbc")
    by_cantools = partial(database.decode_message, message.cob_id_base + NODE_ID)
    return {BY_HAND: _by_hand(message), CANTOOLS: by_cantools, CANOPEN: _canopen(message)}


def _bits(message: Message) -> list[tuple[str, int]]:
    return [(signal.name, 1 << signal.start_bit - 48) for signal in message.signals if signal.bits == 1]


def _by_hand(message: Message) -> Decode:
    flags, layout = _bits(message), struct.Struct("<hhhBB")

    def decode(data: bytes) -> dict[str, Any]:
        P, phi, theta, status, counter = layout.unpack(data)
        return {
            "P": math.nan if P == UNKNOWN else P / 1000,
            "phi": math.nan if phi == UNKNOWN else phi / 100,
            "theta": math.nan if theta == UNKNOWN else theta / 100,
            "counter": counter,
            **{name: status & bit != 0 for name, bit in flags},
        }

    return decode


def _canopen(message: Message) -> Decode:
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
    for index, sub, _size in message.mapping:
        pdo.add_variable(index, sub).od.factor = scales[index, sub]
    P, phi, theta, status, counter = pdo.map
    flags = _bits(message)

    def decode(data: bytes) -> dict[str, Any]:
        pdo.on_message(pdo.cob_id, bytearray(data), 0.0)
        bits, values = status.raw, {"P": P.phys, "phi": phi.phys, "theta": theta.phys, "counter": counter.raw}
        return values | {name: bits & bit != 0 for name, bit in flags}

    return decode


def _study(series: list[Series], unknown_shown: dict[str, int], count: int) -> Study:
    seconds = {method.method: method.points[-1].timing.seconds for method in series}
    alone = series[0].points[0].timing.seconds
    faster = {method: f"{seconds[method] / seconds[OURS]:.0f} times" for method in (BY_HAND, CANTOOLS, CANOPEN)}
    loud = tuple(method for method, shown in unknown_shown.items() if shown)
    silent = ", ".join(method for method in unknown_shown if method not in loud)
    return Study(
        key="decoders",
        title="Decoders of the contact PDO",
        error_unit="largest error (steps of the signal's resolution)",
        work_unit="s per frame",
        reference=f"the raw integers as exact fractions of {count} random frames; all decoders give all signals",
        reference_error=0.0,
        series=tuple(series),
        remarks=(
            f"With {BATCHES[-1]} frames a call tipforce is {faster[BY_HAND]} as fast as the loop with struct, "
            f"{faster[CANTOOLS]} as fast as cantools and {faster[CANOPEN]} as fast as canopen.",
            f"With one frame a call it takes {alone / seconds[BY_HAND]:.0f} times as long as the loop with struct: "
            "collect frames first.",
            *(f"{m}: {unknown_shown[m]} unknown values (raw {UNKNOWN}) were decoded as numbers." for m in loud),
            f"Every unknown value was reported as unknown by: {silent}.",
        ),
        needs=(Need("decode a log exactly", 1e-6, "steps", loud),),
    )
