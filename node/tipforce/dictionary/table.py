"""The object dictionary of a fingertip node, from which every other form (EDS, DBC, docs, accessors, the node) is made.

An object is ``(index, object_code, name, slug, entries)``; a run of equal entries is ``(sub, count, name, slug, type,
access, flags, default, low, high, unit)``, ``name`` and ``default`` tuples where they differ. ``type`` is a letter of
``struct``, "s" a VISIBLE_STRING, "D" a DOMAIN. The tuples run on MicroPython too."""

from canopen_device.core import codes, communication, object_dictionary
from tipforce.dictionary import indices

TYPE_CHECKING = False
if TYPE_CHECKING:  # never run: MicroPython has no typing
    from typing import Any, TypeAlias

    Value: TypeAlias = int | float | str
    Limit: TypeAlias = int | float | None
    # (sub, count, name, slug, type, access, flags, default, low, high, unit)
    Run: TypeAlias = tuple[
        int, int, str | tuple[str, ...], str, str, str, int, Value | tuple[Value, ...], Limit, Limit, str
    ]
    # (index, object_code, name, slug, entries)
    Object: TypeAlias = tuple[int, int, str, str, tuple[Run, ...]]
    Mapped: TypeAlias = tuple[tuple[int, int], ...]
    # (number, message, COB-ID base, enabled, transmission type, event timer ms, mapping)
    Pdo: TypeAlias = tuple[int, str, int, bool, int, int, Mapped]
    # (symbol, what, 6131h unit, 6132h digits, 6110h type, unit, low, high)
    Channel: TypeAlias = tuple[str, str, int, int, int, str, float, float]
    # (bits, counts per microstrain), and where gauges differ for each (counts at 0, counts at 1000 microstrain)
    Converter: TypeAlias = tuple[int, float] | tuple[int, float, tuple[tuple[float, float], ...]]

U8, U16, U32, I16, I32, REAL32, STRING, DOMAIN = "B", "H", "I", "h", "i", "f", "s", "D"
VAR, ARRAY, RECORD = 7, 8, 9

# Flags, those of the device core.
TPDO = object_dictionary.TPDO  # may be mapped into a TPDO
RPDO = object_dictionary.RPDO  # may be mapped into an RPDO
ADD_NODE_ID = object_dictionary.ADD_NODE_ID  # the default is this number plus the node-id
STAGED = object_dictionary.ANY_FLOAT  # part of the calibration record, in table order; NaN may be staged
VIEW = object_dictionary.VIEW  # another form of a 6xxxh value: not a value of its own, never stored
NOT_STORED = object_dictionary.NOT_STORED  # read-write, but a state and not a setting
COUNTED = object_dictionary.COUNTED  # decides what is sent or what it means: a change of it counts in 2126h

MAX_MAPPED = 8

# The profile area has one value in three forms: from the index of the REAL32 form (6xxxh) to the INTEGER16 form (7xxxh)
# and the INTEGER32 form (9xxxh). The integer forms are views (VIEW).
INT16_FORM, INT32_FORM = 1 << 12, 3 << 12

MICROSTRAIN, NEWTON, DEGREE = 0xFA010100, 0x00210000, 0x00410000  # object 6131h, CiA 303-2
UNKNOWN_I16, UNKNOWN_I32, UNKNOWN_U16 = -0x8000, -0x80000000, 0xFFFF

SIGNATURE_ZERO, SIGNATURE_TARA = 0x6F72657A, 0x61726174  # "zero", "tara"
SIGNATURE_COMMIT, SIGNATURE_OPEN = 0x74696D63, 0x6E65706F  # "cmit", "open"

SOFTWARE_VERSION = "0.1.0"
REVISION = 0x00020000
# Product code 1018h:2: the sensor, options, and the number of gauges in the last four bits.
PRODUCT, PRODUCT_SIMULATED, PRODUCT_24_BIT, PRODUCT_GAUGES = 0x54500000, 0x100, 0x200, 0xF
# Of the gauges: (bits, counts per microstrain). Both have a full scale of 3276.8 microstrain.
CONVERTER_16, CONVERTER_24 = (16, 10.0), (24, 2560.0)
MIN_GAUGES, MAX_GAUGES = 3, 8
# Of a calibration record that a node commits (2104h), index << 8 | sub-index: what is at least 0, of an array all its
# entries; what is at most another. And the 2-norm of C, N per unit strain: beyond, some unit is mistaken.
NOT_NEGATIVE = (0x211201, 0x211202, 0x211205, 0x211300, 0x211600)
IN_ORDER = ((0x211002, 0x211003), (0x211005, 0x211004), (0x211203, 0x211204))
NORM_MIN, NORM_MAX = 10.0, 1e7
SAMPLES = 256  # modulus of the counter of samples 2121h: where SYNCs have no numbers
CUSTOM_LAYOUT = 255  # 2102h:4, besides 1, 2, 3 for cases I, II, III

# Status byte 2120h, bit 0 first: the names are those of the DBC's single-bit signals.
STATUS_BITS = (
    ("contact", "contact present"),
    ("calibrated", "a calibration is active"),
    ("saturated", "a gauge is saturated or overloaded, or (more than 3 gauges) left out"),
    ("stale", "no new sample since the last one"),
    ("theta_unresolved", "uncertainty of theta over 30 degrees, or P below contact-off"),
    ("misses_tip", "the line of action misses the tip"),
    ("outside_pad", "theta outside the pad"),
    ("fault", "front-end fault, see 2124h"),
)
# Front-end faults 2124h: bits 0-7 are gauges 1-8; 12 to 15 are what the calibration says of the sample.
FAULT_NO_DATA, FAULT_FROZEN, FAULT_WIRE_BREAK, FAULT_SUPPLY = 8, 9, 10, 11
FAULT_CONTRADICTION, FAULT_BEYOND_CALIBRATED, FAULT_TEMPERATURE, FAULT_OVERLOAD = 12, 13, 14, 15
FAULT_BITS = (
    (FAULT_NO_DATA, "no_data", "front end: no data"),
    (FAULT_FROZEN, "frozen", "front end: frozen"),
    (FAULT_WIRE_BREAK, "wire_break", "front end: wire break"),
    (FAULT_SUPPLY, "supply", "front end: supply"),
    (FAULT_CONTRADICTION, "contradiction", "the gauges contradict each other"),
    (FAULT_BEYOND_CALIBRATED, "beyond_calibrated", "force beyond the calibrated force: extrapolated"),
    (FAULT_TEMPERATURE, "temperature", "temperature outside the calibration, or unknown where it is needed"),
    (FAULT_OVERLOAD, "overload", "force beyond the overload force"),
)
# EMCY error codes of the application; those of CiA 301 are in canopen_device.core.emcy.
EMCY_TEMPERATURE, EMCY_GAUGE_SATURATED, EMCY_FRONT_END, EMCY_CALIBRATION_INVALID = 0x4210, 0x5010, 0x5030, 0x6320
EMCY_OVERLOAD = 0x5020
COMMAND_TARE, COMMAND_CLEAR_TARE, COMMAND_ZERO = 1, 2, 3


def forms(index: int) -> "tuple[int, int, int]":
    """The indices of a value of the profile area: as REAL32, INTEGER16 and INTEGER32."""
    return index, index + INT16_FORM, index + INT32_FORM


def channels(n: int) -> "tuple[Channel, ...]":
    """The n + 6 channels, sub-index 1 first; ``low`` and ``high`` are what INTEGER16 carries at that resolution."""
    gauges: tuple[Channel, ...] = tuple(
        ("SG%d" % k, "strain of gauge %d" % k, MICROSTRAIN, 1, 70, "microstrain", -3276.7, 3276.7)
        for k in range(1, n + 1)
    )
    return gauges + (
        ("F1", "P sin(phi)", NEWTON, 3, 10001, "N", -32.767, 32.767),
        ("F2", "P sin(phi-theta)", NEWTON, 3, 10001, "N", -32.767, 32.767),
        ("F3", "P cos(phi)", NEWTON, 3, 10001, "N", -32.767, 32.767),
        ("P", "force magnitude", NEWTON, 3, 10002, "N", 0.0, 32.767),
        ("phi", "force direction", DEGREE, 2, 10003, "degree", -180.0, 180.0),
        ("theta", "contact angle", DEGREE, 2, 10003, "degree", -180.0, 180.0),
    )


def tpdos(n: int) -> "tuple[Pdo, ...]":
    """TPDOs in the form of ``Pdo``, mappings as (index, sub): 18xxh, 1Axxh and the DBC messages follow from them."""
    status, counter = (indices.STATUS, 0), (indices.COUNTER, 0)
    health = (
        (indices.TEMPERATURE, 0), (indices.U_P, 0), (indices.FAULTS, 0), (indices.CONFIGURATION_COUNTER, 0),
        (communication.ERROR_REGISTER, 0),
    )  # fmt: skip
    declared: list[Pdo] = [
        (1, "Gauges", codes.TPDO_BASES[0], True, 1, 0, _run(1, 3) + (status, counter)),
        (2, "Contact", codes.TPDO_BASES[1], True, 1, 0, _run(n + 4, n + 6) + (status, counter)),
        (3, "Force", codes.TPDO_BASES[2], False, 1, 0, _run(n + 1, n + 3) + (status, counter)),
        (4, "Health", codes.TPDO_BASES[3], False, 255, 1000, health),
    ]
    if n > 3:
        declared.append((5, "Gauges2", 0, False, 1, 0, _run(4, min(n, 6)) + (status, counter)))
    if n > 6:
        declared.append((6, "Gauges3", 0, False, 1, 0, _run(7, n) + (status, counter)))
    return tuple(declared)


def rpdos() -> "tuple[Pdo, ...]":
    """RPDO declarations, in the form of ``tpdos``."""
    return ((1, "Command", codes.RPDO_BASES[0], False, 255, 0, ((indices.COMMAND, 0),)),)


def product_code(n: int, simulated: bool, converter: "Converter" = CONVERTER_16) -> int:
    """Object 1018h:2 of a node with ``n`` gauges."""
    options = (PRODUCT_24_BIT if converter[0] > 16 else 0) | (PRODUCT_SIMULATED if simulated else 0)
    return PRODUCT | options | n


def mapped_bits(index: int) -> int:
    """Length in bits of an object that the default PDOs map."""
    bytes_ = (communication.ERROR_REGISTER, indices.STATUS, indices.COUNTER, indices.CONFIGURATION_COUNTER)
    return 8 if index in bytes_ else 16


def _run(first: int, last: int) -> "Mapped":
    return tuple((indices.PROCESS_VALUE + INT16_FORM, sub) for sub in range(first, last + 1))


def run(
    first: int, count: int, names: "str | tuple[str, ...]", slug: str, kind: str, access: str, flags: int = 0,
    default: "Value | tuple[Value, ...]" = 0, low: "Limit" = None, high: "Limit" = None, unit: str = "",
) -> "Run":  # fmt: skip
    """Equal entries from sub-index ``first`` on; the functions below pass ``rest`` from ``kind`` on."""
    return (first, count, names, slug, kind, access, flags, default, low, high, unit)


def var(index: int, name: str, slug: str, *rest: "Any", **unit: "Any") -> "Object":
    """A variable: an object of one value."""
    return (index, VAR, name, slug, (run(0, 1, name, slug, *rest, **unit),))


def array(
    index: int, name: str, slug: str, count: int, names: "str | tuple[str, ...]", *rest: "Any", **unit: "Any"
) -> "Object":
    """An array of ``count`` values of one type; its sub-index 0 is added."""
    return (index, ARRAY, name, slug, (run(1, count, names, slug, *rest, **unit),))


def record(index: int, name: str, slug: str, *entries: "tuple[Any, ...]") -> "Object":
    """A record of entries (sub, name, slug, rest...)."""
    return (index, RECORD, name, slug, tuple([run(e[0], 1, e[1], slug + "." + e[2], *e[3:]) for e in entries]))
