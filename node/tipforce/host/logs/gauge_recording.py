"""A recording of gauges as the source of a node: calibration data (CSV) with times, or a candump log."""

from contextlib import suppress
from pathlib import Path

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.dictionary import table
from tipforce.errors import InputError
from tipforce.fingertip.source import convert
from tipforce.host.configuration.measurements import read_measurements
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.logs.reader import open_log
from tipforce.sources.replay import ReplaySource

_ENDS_16, _ENDS_24 = (-0x8000, 0x7FFF), (-0x800000, 0x7FFFFF)
_END_MICROSTRAIN = 3276.65  # of a PDO; where a converter ends within, the flag does not say which gauge was saturated


def open_recording(text: str, gauges: int, speed: float, loop: bool, bits: int) -> ReplaySource:
    """Read ``FILE``, or ``FILE@ID``, a node of a log: a CSV with ``t_s``, SG1..SGn in microstrain, or PDOs of three
    gauges, as counts of ``bits`` bits, full scale 3276.8 microstrain. Raises InputError naming the place."""
    path, node_id = _split(text)
    is_csv = node_id is None and _looks_like_csv(path)
    t_s, microstrain, degC = _from_csv(path) if is_csv else _from_log(path, node_id)
    if microstrain.shape[1] != gauges:
        raise InputError(f"replay:{text}: {microstrain.shape[1]} gauges; the layout has {gauges}")
    converter, ends = (table.CONVERTER_24, _ENDS_24) if bits == 24 else (table.CONVERTER_16, _ENDS_16)
    times_us = [round(1e6 * t) for t in t_s.tolist()]
    try:
        rows = [_counts(row, converter[1], ends) for row in microstrain.tolist()]
        hundredths = None
        if degC is not None:
            hundredths = [round(100.0 * t) if -327.67 < t < 327.67 else table.UNKNOWN_I16 for t in degC.tolist()]
        return ReplaySource(times_us, rows, converter, ends, speed, loop, hundredths)
    except ValueError as error:
        raise InputError(f"replay:{text}: {error}") from None


def _split(text: str) -> tuple[str, int | None]:
    path, at, number = text.rpartition("@")
    if not at or Path(text).exists():
        return text, None
    with suppress(ValueError):
        if 1 <= int(number, 0) <= 127:
            return path, int(number, 0)
    raise InputError(f"replay:{text}: {number!r} after @: allowed are node-ids from 1 to 127")


def _looks_like_csv(path: str) -> bool:
    """Return whether the file has a header with a gauge column; the reader of the file reports an unreadable file."""
    try:
        with open(path, encoding="utf-8", errors="replace") as file:
            head = file.readline()
    except OSError as error:
        raise InputError(f"replay:{path}: {error.strerror}") from None
    names = [name.strip().strip('"') for name in head.lstrip("\ufeff").split(",")]
    return any(name in ("SG1", "e1_ue") for name in names)


def _from_csv(path: str) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    data = read_measurements(path, loads=False)
    if data.t_s is None:
        raise InputError(f"replay:{path}: column t_s is missing; a replay needs the time of each row in seconds")
    if data.bad:
        raise InputError(f"replay:{path}: {data.bad[0]}")
    return data.t_s, 1e6 * data.strain, data.temperature_degC


def _from_log(path: str, node_id: int | None) -> tuple[FloatArray, FloatArray, None]:
    decoder = Decoder()
    readings: dict[int, list[tuple[FloatArray, FloatArray]]] = {}
    names = ("SG1", "SG2", "SG3", "stale", "fault", "saturated")
    with open_log(path) as log:
        for frames in log:
            for (sender, _message), samples in decoder.decode(frames, names).items():
                columns = samples.columns
                if all(name in columns for name in names):
                    strain = np.column_stack([columns[name] for name in names[:3]]).astype(np.float64)
                    saturated, at_end = columns["saturated"], np.abs(strain) > _END_MICROSTRAIN
                    strain[at_end & saturated[:, np.newaxis]] *= 1e6  # at the end of any converter
                    strain[columns["stale"] | columns["fault"] | saturated & ~at_end.any(axis=1)] = np.nan
                    readings.setdefault(sender, []).append((np.multiply(samples.t_ns, 1e-9, dtype=np.float64), strain))
    if node_id is None and len(readings) > 1:
        ids = ", ".join(map(str, sorted(readings)))
        raise InputError(f"replay:{path}: contains gauges of the nodes {ids}; choose one: {path}@{min(readings)}")
    chosen = node_id if node_id is not None else next(iter(readings), None)
    if chosen not in readings:
        whose = "" if node_id is None else f" of node {node_id}"
        raise InputError(
            f"replay:{path}: no gauge PDO{whose}, and no CSV header with SG1; "
            "a recording is a CSV file with t_s,SG1,SG2,SG3 or a candump log with frames 0x180 + node-id"
        )
    t_s, microstrain = map(np.concatenate, zip(*readings[chosen], strict=True))
    return t_s, microstrain, None


def _counts(row: list[float], per_microstrain: float, ends: tuple[int, int]) -> tuple[int, ...] | None:
    if any(value - value != 0.0 for value in row):
        return None
    counts = [convert(per_microstrain * value, *ends) for value in row]
    return tuple([ends[0] if count == -ends[1] else count for count in counts])
