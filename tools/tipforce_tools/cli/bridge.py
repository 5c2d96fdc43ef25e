"""The [bridge] table of a layout file, and the scaling 6120h to 6123h computed from it and a converter's scale.

(raw + offset) * scale is the voltage at the converter in millivolts (Linux, sysfs-bus-iio). The bridge gives
gauge factor * arms * excitation volts per unit strain (``tipforce.sources.front_end.Bridge``), times the gain of an
amplifier, on top of the voltage at no strain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple

import msgspec

from tipforce.errors import InputError

if TYPE_CHECKING:
    from tipforce.dictionary.table import Converter

_I16 = 0x7FFF
_FULL_MICROSTRAIN = 1000.0  # the process value of the second scaling point, 6123h


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


class ChannelScale(NamedTuple):
    """What the driver states about one channel."""

    millivolts_per_count: float | None
    offset_counts: float
    why: str
    """The reason for a missing scale; empty if there is a scale."""


def check_bridge(table: BridgeTable) -> None:
    """Raises InputError that names a number outside the allowed range."""
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


def converter_of(table: BridgeTable, channels: Sequence[ChannelScale], names: Sequence[str], bits: int) -> Converter:
    """Return the converter for the dictionary, with the scaling points of each gauge.

    Raises InputError if a channel has no scale and the table states none.
    """
    from tipforce.sources.front_end import Bridge

    bridge = Bridge(table.kind, table.gauge_factor, table.excitation_volts)
    gains = table.gain if isinstance(table.gain, list) else [table.gain] * len(channels)
    if len(gains) != len(channels):
        raise InputError(f"[bridge] gain: {len(gains)} numbers for {len(channels)} gauges")
    points = []
    for channel, gain, name in zip(channels, gains, names, strict=True):
        volts_per_count = _volts_per_count(table, channel, name)
        zero = table.zero_volts / volts_per_count - channel.offset_counts
        points.append((zero, zero + _FULL_MICROSTRAIN * gain * bridge.volts_per_microstrain / volts_per_count))
    per_microstrain = abs(points[0][1] - points[0][0]) / _FULL_MICROSTRAIN
    fits = all(abs(count) <= _I16 for pair in points for count in pair)
    return (bits if fits else max(bits, 17)), per_microstrain, tuple(points)


def ends_fit(ends: tuple[int, int]) -> int:
    """Return the bits that a signed integer needs for a converter's range: 16 or more."""
    bits = 16
    while not -(1 << bits - 1) <= ends[0] <= ends[1] < 1 << bits - 1:
        bits += 1
    return bits


def _volts_per_count(table: BridgeTable, channel: ChannelScale, name: str) -> float:
    if table.volts_per_count is not None:
        return table.volts_per_count
    if channel.millivolts_per_count is None:
        raise InputError(
            f"{name}: {channel.why}; state the converter's step in the layout file: "
            "[bridge] volts_per_count = (reference voltage / number of counts)"
        )
    if not (math.isfinite(channel.millivolts_per_count) and channel.millivolts_per_count > 0.0):
        raise InputError(f"{name}: scale {channel.millivolts_per_count!r}; state [bridge] volts_per_count")
    return 1e-3 * channel.millivolts_per_count


def _finite(name: str, value: float, positive: bool = False) -> float:
    if not math.isfinite(value) or (positive and value <= 0.0):
        raise InputError(f"[bridge] {name} = {value!r}: allowed is a {'positive' if positive else 'finite'} number")
    return value
