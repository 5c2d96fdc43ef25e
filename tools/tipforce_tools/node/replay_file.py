"""Recordings for `tipforce node --source replay:FILE`: calibration data (CSV) with times, or a candump log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.dictionary import table
from tipforce.errors import InputError

if TYPE_CHECKING:
    from tipforce.arrays import FloatArray
    from tipforce.sources.replay import ReplaySource


_ENDS_16, _ENDS_24 = (-0x8000, 0x7FFF), (-0x800000, 0x7FFFFF)


def open_replay(text: str, gauges: int, speed: float = 1.0, loop: bool = False, bits: int = 16) -> ReplaySource:
    """The recording ``FILE``, or ``FILE@ID`` for one node of a log. Raises InputError naming file and place.

    A CSV file needs ``t_s`` and SG1..SGn in microstrain; a log needs the gauge PDOs (0x180 + node-id) of three
    gauges. Counts are those of a converter of ``bits`` bits with a full scale of 3276.8 microstrain.
    """
    from tipforce.sources.replay import ReplaySource

    path, node_id = _split(text)
    is_csv = node_id is None and _looks_like_csv(path)
    t_s, microstrain, degC = _from_csv(path) if is_csv else _from_log(path, node_id)
    if microstrain.shape[1] != gauges:
        raise InputError(f"replay:{text}: {microstrain.shape[1]} gauges; the layout has {gauges}")
    converter, ends = (table.CONVERTER_24, _ENDS_24) if bits == 24 else (table.CONVERTER_16, _ENDS_16)
    times_us = [round(1e6 * t) for t in t_s.tolist()]
    try:
        rows = [_counts(row, converter[1], ends) for row in microstrain.tolist()]
        return ReplaySource(times_us, rows, converter, ends, speed, loop, None if degC is None else _hundredths(degC))
    except ValueError as error:
        raise InputError(f"replay:{text}: {error}") from None


def _split(text: str) -> tuple[str, int | None]:
    path, at, number = text.rpartition("@")
    if not at or Path(text).exists():
        return text, None
    try:
        found = int(number, 0)
    except ValueError:
        found = 0
    if not 1 <= found <= 127:
        raise InputError(f"replay:{text}: {number!r} after @ is no node-id, allowed are 1 to 127")
    return path, found


def _looks_like_csv(path: str) -> bool:
    """A header with a gauge column; what cannot be read is said by the reader of the file."""
    try:
        with open(path, encoding="utf-8", errors="replace") as file:
            head = file.readline()
    except OSError as error:
        raise InputError(f"replay:{path}: {error.strerror}") from None
    names = [name.strip().strip('"') for name in head.lstrip("\ufeff").split(",")]
    return any(name in ("SG1", "e1_ue") for name in names)


def _from_csv(path: str) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    from tipforce.host.configuration.measurements import read_measurements
    from tipforce_tools.cli.one_finger_csv import check_one_node

    data = read_measurements(path, loads=False)
    check_one_node(path, data)
    if data.t_s is None:
        raise InputError(f"replay:{path}: there is no column t_s; a replay needs the time of each row in seconds")
    if data.bad:
        raise InputError(f"replay:{path}: {data.bad[0]}")
    return data.t_s, 1e6 * data.strain, data.temperature_degC


def _from_log(path: str, node_id: int | None) -> tuple[FloatArray, FloatArray, None]:
    import numpy as np

    from tipforce.host.decoding.decoder import Decoder
    from tipforce.host.logs.candump import read_candump

    decoder = Decoder()
    times: dict[int, list[FloatArray]] = {}
    values: dict[int, list[FloatArray]] = {}
    names = ("SG1", "SG2", "SG3", "stale", "fault")
    with open(path, encoding="utf-8", errors="replace") as file:
        for block in read_candump(file):
            for (found_id, _message), samples in decoder.decode(block.frames, names).items():
                columns = samples.columns
                if not all(name in columns for name in names):
                    continue
                strain = np.column_stack([columns[name] for name in names[:3]]).astype(np.float64)
                strain[columns["stale"] | columns["fault"]] = np.nan
                times.setdefault(found_id, []).append(np.asarray(samples.t_ns * 1e-9, dtype=np.float64))
                values.setdefault(found_id, []).append(strain)
    if node_id is None and len(times) > 1:
        ids = ", ".join(str(found) for found in sorted(times))
        raise InputError(f"replay:{path}: holds gauges of the nodes {ids}; name one as {path}@{min(times)}")
    chosen = node_id if node_id is not None else next(iter(times), None)
    if chosen not in times:
        whose = "" if node_id is None else f" of node {node_id}"
        raise InputError(
            f"replay:{path}: no gauge PDO{whose} in it, and no CSV header with SG1; "
            "a recording is a CSV file with t_s,SG1,SG2,SG3 or a candump log with frames 0x180 + node-id"
        )
    return np.concatenate(times[chosen]), np.concatenate(values[chosen]), None


def _counts(row: list[float], per_microstrain: float, ends: tuple[int, int]) -> tuple[int, ...] | None:
    """A row in counts; None where a gauge is unknown. What a PDO shows at its end (+-3276.7) was saturated."""
    from tipforce.fingertip.source import convert

    if any(value - value != 0.0 for value in row):
        return None
    found = [convert(per_microstrain * value, *ends) for value in row]
    return tuple([ends[0] if count == -ends[1] else count for count in found])


def _hundredths(degC: FloatArray) -> list[int]:
    return [round(100.0 * t) if -327.67 < t < 327.67 else table.UNKNOWN_I16 for t in degC.tolist()]
