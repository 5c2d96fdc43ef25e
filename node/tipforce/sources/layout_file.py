"""Gauge layouts by name or file: I, II, III (their mirrors I', II', III'), or a TOML file.

A file lists the gauges, SG1 first, three to eight: points of Table 1, or places along the beams, or both::

    points = ["K_H", "S_H", "U"]

::

    points = [
        { beam = "H", side = "left", position_mm = 1.08 }, { beam = "H", side = "right", position_mm = 1.08 }, "U",
    ]
    gauge_length_mm = 1.0

beam: "H", the horizontal one, or "V", the vertical one. side: on H the arm at negative ("left") or positive x
("right"), on V the face there. position_mm: the middle of the gauge, counted along the beam from the joint: on H from
the middle of the body up to a, on V from the lower side of the horizontal beam up to d. face: on H "lower" (towards the
fixture, the default) or "upper" (in the slit). gauge_length_mm documents the gauge of the design; it changes no number,
because strain is linear along a beam. A table [geometry] has all of a_m, d_m, r_m, h1_m, h2_m, width_m and
youngs_modulus_pascals (metres, Pa; ``sensor.Geometry``), if they differ from the paper's. A [bridge] table
(``BridgeTable``, docs/hardware.md) states the wiring of the gauges to a real converter, for `tipforce node --source
iio:...` alone.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import msgspec

from canopen_device.toml_table import convert, read_table
from tipforce.errors import InputError, placed
from tipforce.output_file import LAYOUT, write_file
from tipforce.sensor.structure.layouts import LAYOUTS, layout
from tipforce.sensor.structure.strain import FABRICATED, Gauge, GaugePosition, Geometry, check_gauges


class _Place(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    beam: Literal["H", "V"]
    side: Literal["left", "right"]
    position_mm: float
    face: Literal["lower", "upper"] | None = None


class _Body(msgspec.Struct):  # unknown keys are ignored
    a_m: float
    d_m: float
    r_m: float
    h1_m: float
    h2_m: float
    width_m: float
    youngs_modulus_pascals: float


class BridgeTable(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """How the gauges are wired to the converter; one description for all of them."""

    kind: Literal["quarter", "half", "full"] = "quarter"
    gauge_factor: float = 2.0
    excitation_volts: float = 3.3
    gain: float | list[float] = 1.0
    """Gain of an amplifier between bridge and converter, one for all or one per gauge; negative: inputs swapped."""
    zero_volts: float = 0.0
    """Voltage at the converter with no strain: the amplifier's zero output."""
    volts_per_count: float | None = None
    """Used only if the converter states no scale."""
    count_range: tuple[int, int] | None = None
    """The converter's lowest and highest count, if the driver does not state them."""
    supply: str | None = None
    """DEVICE/CHANNEL that measures the excitation, compared with ``excitation_volts``."""
    supply_divider: float = 1.0
    """Excitation divided by the voltage at that channel."""
    supply_tolerance: float = 0.05
    """Relative tolerance of the excitation."""


class _File(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    points: tuple[str | _Place, ...]
    gauge_length_mm: float | None = None
    geometry: _Body | None = None
    bridge: BridgeTable | None = None


def read_bridge(name_or_path: str) -> BridgeTable | None:
    """Return the [bridge] table of a layout file, None without one. Raises InputError naming place and limits."""
    if name_or_path in LAYOUTS:
        return None
    content = _content(name_or_path)
    with placed(f"layout {name_or_path}"):
        _geometry(content)
        table = content.bridge
        if table is not None:
            for name in ("gauge_factor", "excitation_volts", "supply_divider", "supply_tolerance"):
                _finite(name, getattr(table, name), positive=True)
            _finite("zero_volts", table.zero_volts)
            for gain in table.gain if isinstance(table.gain, list) else [table.gain]:
                if _finite("gain", gain) == 0.0:
                    raise InputError("[bridge] gain = 0: allowed are numbers other than 0")
            if table.volts_per_count is not None:
                _finite("volts_per_count", table.volts_per_count, positive=True)
            if table.count_range is not None and table.count_range[0] >= table.count_range[1]:
                raise InputError(f"[bridge] count_range = {list(table.count_range)}: allowed is [lowest, highest]")
    return table


def read_layout(name_or_path: str) -> tuple[Geometry, tuple[Gauge, ...]]:
    """Return (geometry, gauges) for gauge_matrix(). Raises InputError naming the place and what is allowed."""
    if name_or_path in LAYOUTS:
        return FABRICATED, layout(name_or_path)
    content = _content(name_or_path)
    with placed(f"layout {Path(name_or_path)}"):
        if content.gauge_length_mm is not None and not 0.0 < content.gauge_length_mm < float("inf"):
            raise InputError(f"gauge_length_mm = {content.gauge_length_mm!r}: allowed is a positive length")
        geometry = _geometry(content)
        return geometry, _gauges(geometry, content.points)


def _content(name_or_path: str) -> _File:
    place = f"layout {Path(name_or_path)}"
    try:
        content = read_table(name_or_path, place)
    except InputError as error:
        if not isinstance(error.__cause__, FileNotFoundError):
            raise
        raise InputError(
            f"layout {name_or_path!r}: neither one of {', '.join(LAYOUTS)} nor a file; "
            'a layout file has a line like points = ["K_H", "S_H", "U"]'
        ) from None
    return convert(_File, content, place, finite=False)  # the checks below name non-finite numbers and what is allowed


def layout_text(
    geometry: Geometry, gauges: Sequence[Gauge], gauge_length_m: float | None = None, comment: str = ""
) -> str:
    """Return the text of a layout file with these gauges, after ``comment``. Raises InputError for unusable gauges."""
    import tomli_w

    points: list[str | _Place] = []
    for gauge in check_gauges(geometry, gauges):
        if isinstance(gauge, str):
            points.append(gauge)
        else:
            face: Literal["upper"] | None = "upper" if gauge.beam == "H" and gauge.face == "upper" else None
            points.append(_Place(gauge.beam, gauge.side, gauge.position_m * 1e3, face))
    length_mm = None if gauge_length_m is None else gauge_length_m * 1e3
    content = msgspec.to_builtins(_File(tuple(points), length_mm))
    content["geometry"] = msgspec.to_builtins(geometry)
    head = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    return head + tomli_w.dumps(content)


def write_layout(
    path: str | Path, geometry: Geometry, gauges: Sequence[Gauge], gauge_length_m: float | None = None,
    comment: str = "",
) -> None:  # fmt: skip
    """Write layout_text() to a file. Raises InputError for an unusable path, WriteError if writing fails."""
    write_file(path, layout_text(geometry, gauges, gauge_length_m, comment), LAYOUT)


def _geometry(content: _File) -> Geometry:
    if content.geometry is None:
        return FABRICATED
    sizes = msgspec.structs.asdict(content.geometry)
    for name, value in sizes.items():
        low, high, unit = (1.0, 1e15, "Pa") if name == "youngs_modulus_pascals" else (1e-6, 10.0, "m")
        if not low <= value <= high:
            raise InputError(f"geometry {name} = {value!r}: allowed is {low:g} to {high:g} {unit}")
    return Geometry(**sizes)


def _gauges(geometry: Geometry, points: Sequence[str | _Place]) -> tuple[Gauge, ...]:
    for point in points:
        if isinstance(point, _Place) and point.beam == "V" and point.face is not None:
            allowed = "allowed on beam H only; on V the side determines the face"
            raise InputError(f"face = {point.face!r} on beam V: {allowed}")
    return check_gauges(geometry, [
        point if isinstance(point, str)
        else GaugePosition(point.beam, point.side, point.position_mm / 1e3, point.face or "lower")
        for point in points
    ])  # fmt: skip


def _finite(name: str, value: float, positive: bool = False) -> float:
    if not math.isfinite(value) or (positive and value <= 0.0):
        raise InputError(f"[bridge] {name} = {value!r}: allowed is a {'positive' if positive else 'finite'} number")
    return value
