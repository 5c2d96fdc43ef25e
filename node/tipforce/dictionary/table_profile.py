"""The profile area of the dictionary of a fingertip node, CiA 404: 6000h to 9FFFh."""

from tipforce.dictionary.table import (
    ARRAY,
    COUNTED,
    I16,
    I32,
    INT16_FORM,
    INT32_FORM,
    REAL32,
    TPDO,
    U8,
    U16,
    U32,
    VIEW,
    array,
    channels,
)

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator

    from tipforce.dictionary.table import Converter, Limit, Object, Value

# A table: one entry a line says more than one argument a line.
# fmt: off


def profile(n: int, converter: "Converter") -> "Iterator[Object]":
    """Objects of CiA 404 for each gauge channel."""
    chans = channels(n)
    symbols = tuple(c[0] for c in chans)
    total = n + 6

    def single(
        index: int, name: str, slug: str, count: int, kind: str, access: str, flags: int = 0,
        default: "Value | tuple[Value, ...]" = 0, low: "Limit" = None, high: "Limit" = None, unit: str = "",
    ) -> "Object":
        names = symbols[:count]
        return array(index, name, slug, count, names, kind, access, flags, default, low, high, unit)

    yield from (
        single(0x6110, "AI sensor type", "sensor_type", total, U16, "ro", 0, tuple(c[4] for c in chans)),
        single(0x6112, "AI operating mode", "operating_mode", total, U8, "rw", COUNTED, 1, 1, 1),
        single(0x6114, "AI sample period", "sample_period_us", total, U32, "rw", 0, 500, 100, 1000000, "us"),
        single(0x6125, "AI autozero", "autozero", n, U32, "wo"),
        single(0x6131, "AI physical unit", "unit", total, U32, "ro", 0, tuple(c[2] for c in chans)),
        single(0x6132, "AI decimal digits", "decimal_digits", total, U8, "ro", 0, tuple(c[3] for c in chans)),
        (
            0x6139, ARRAY, "AI autotare", "autotare",
            (
                (0, 1, "Highest sub-index supported", "count", U8, "const", 0, n + 1, None, None, ""),
                (n + 1, 1, "F1, F2, F3", "autotare", U32, "wo", 0, 0, None, None, ""),
            ),
        ),
        single(0x6150, "AI status", "channel_status", total, U8, "ro", TPDO),
        single(0x61A0, "AI filter type", "filter_type", n, U8, "rw", COUNTED, 0, 0, 100),
        single(0x61A1, "AI filter constant", "filter_constant", n, U16, "rw", COUNTED, 1, 1, 65535),
    )
    zero: "float | tuple[float, ...]" = 0.0
    full: "float | tuple[float, ...]" = 1000.0 * converter[1]
    if len(converter) > 2:
        zero, full = tuple(points[0] for points in converter[2]), tuple(points[1] for points in converter[2])
    lows, highs = tuple(c[6] for c in chans), tuple(c[7] for c in chans)
    # One value in three forms: REAL32 (6xxxh, the value itself), INTEGER16 and INTEGER32 (views).
    for offset, name, slug, count, access, default, unit in (
        (0x100, "field value", "field_value", n, "ro", 0.0, "counts"),
        (0x120, "scaling 1 field value", "scaling_1_field", n, "rw", zero, "counts"),
        (0x121, "scaling 1 process value", "scaling_1_process", n, "rw", 0.0, "microstrain"),
        (0x122, "scaling 2 field value", "scaling_2_field", n, "rw", full, "counts"),
        (0x123, "scaling 2 process value", "scaling_2_process", n, "rw", 1000.0, "microstrain"),
        (0x124, "process value offset", "process_offset", n, "rw", 0.0, "microstrain"),
        (0x130, "process value", "process_value", total, "ro", 0.0, "unit of 6131h"),
        (0x133, "interrupt delta", "interrupt_delta", total, "rw", 0.0, "unit of 6131h"),
        (0x134, "interrupt lower limit", "interrupt_lower", total, "rw", lows, "unit of 6131h"),
        (0x135, "interrupt upper limit", "interrupt_upper", total, "rw", highs, "unit of 6131h"),
        (0x136, "interrupt hysteresis", "interrupt_hysteresis", total, "rw", 0.0, "unit of 6131h"),
        (0x148, "span start", "span_start", total, "rw", lows, "unit of 6131h"),
        (0x149, "span end", "span_end", total, "rw", highs, "unit of 6131h"),
    ):
        flags = TPDO if access == "ro" else 0
        digits = tuple(0 if unit == "counts" else c[3] for c in chans[:count])
        yield array(
            0x6000 + offset, "AI " + name, slug, count, symbols[:count], REAL32, access,
            flags if access == "ro" else COUNTED,
            default if isinstance(default, float) else default[:count], unit=unit,
        )
        for form, kind, suffix in ((INT16_FORM, I16, "int16"), (INT32_FORM, I32, "int32")):
            if kind == I16 and unit == "counts" and converter[0] > 16:
                continue
            yield array(
                0x6000 + form + offset, "AI " + name + " " + suffix, slug + "_" + suffix, count, symbols[:count],
                kind, access, flags | VIEW, _scaled(default, digits),
                unit=unit if unit == "counts" else "resolution of 6132h",
            )


def _scaled(default: "float | tuple[float, ...]", digits: "tuple[int, ...]") -> "tuple[int, ...]":
    """The integer form of REAL32 defaults: times ten to the 6132h digits of each channel."""
    values = (default,) * len(digits) if isinstance(default, float) else default
    return tuple(round(values[k] * 10 ** digits[k]) for k in range(len(digits)))
