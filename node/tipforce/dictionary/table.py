"""The object dictionary of a fingertip node, once: every other form of it (EDS, DBC, docs, accessors, the
node's own) is generated from here.

Plain tuples in the subset that CPython and MicroPython share, because the node itself is built from them.

An object is ``(index, object_code, name, slug, entries)``; a run of equal entries is
``(sub, count, name, slug, type, access, flags, default, low, high, unit)``. ``name`` and ``default`` are
tuples where the entries of one run differ. The type is the letter that ``struct`` uses, "s" a VISIBLE_STRING,
"D" a DOMAIN. Sub-index 0 is added by ``objects()`` where an object does not state its own.
"""

from tipforce.device import codes, communication

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

TPDO = 1  # may be mapped into a TPDO
RPDO = 2  # may be mapped into an RPDO
ADD_NODE_ID = 4  # the default is this number plus the node-id
STAGED = 8  # part of the calibration record, in table order; any REAL32 may be staged, NaN included
VIEW = 16  # another form of a 6xxxh value: not a value of its own, never stored
NOT_STORED = 32  # read-write, but a state and not a setting

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
# EMCY error codes of the application; those of CiA 301 are in tipforce.device.emcy.
EMCY_TEMPERATURE, EMCY_GAUGE_SATURATED, EMCY_FRONT_END, EMCY_CALIBRATION_INVALID = 0x4210, 0x5010, 0x5030, 0x6320
EMCY_OVERLOAD = 0x5020
COMMAND_TARE, COMMAND_CLEAR_TARE, COMMAND_ZERO = 1, 2, 3


def channels(n: int) -> "tuple[Channel, ...]":
    """The n + 6 channels, sub-index 1 first, each in the form of ``Channel``.

    ``low`` and ``high`` are the ends of what INTEGER16 can carry at that resolution, in the unit.
    """
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
    """TPDO declarations, each in the form of ``Pdo``; a mapping is a tuple of (index, sub).

    The parameter objects 18xxh and 1Axxh and the DBC messages follow from this.
    """
    status, counter, register = (0x2120, 0), (0x2121, 0), (communication.ERROR_REGISTER, 0)
    declared: list[Pdo] = [
        (1, "Gauges", codes.TPDO_BASES[0], True, 1, 0, _run(0x7130, 1, 3) + (status, counter)),
        (2, "Contact", codes.TPDO_BASES[1], True, 1, 0, _run(0x7130, n + 4, n + 6) + (status, counter)),
        (3, "Force", codes.TPDO_BASES[2], False, 1, 0, _run(0x7130, n + 1, n + 3) + (status, counter)),
        (
            4,
            "Health",
            codes.TPDO_BASES[3],
            False,
            255,
            1000,
            ((0x2122, 0), (0x2123, 0), (0x2124, 0), (0x2126, 0), register),
        ),
    ]
    if n > 3:
        declared.append((5, "Gauges2", 0, False, 1, 0, _run(0x7130, 4, min(n, 6)) + (status, counter)))
    if n > 6:
        declared.append((6, "Gauges3", 0, False, 1, 0, _run(0x7130, 7, n) + (status, counter)))
    return tuple(declared)


def rpdos() -> "tuple[Pdo, ...]":
    """RPDO declarations, in the form of ``tpdos``."""
    return ((1, "Command", codes.RPDO_BASES[0], False, 255, 0, ((0x2130, 0),)),)


def product_code(n: int, simulated: bool, converter: "Converter" = CONVERTER_16) -> int:
    """Object 1018h:2 of a node with ``n`` gauges."""
    options = (PRODUCT_24_BIT if converter[0] > 16 else 0) | (PRODUCT_SIMULATED if simulated else 0)
    return PRODUCT | options | n


def objects(n: int = 3, simulated: bool = False, converter: "Converter" = CONVERTER_16) -> "tuple[Object, ...]":
    """Every object of a node with ``n`` gauges, ordered by index.

    ``simulated`` adds 2200h and 2201h and sets bit 8 of the product code. ``converter`` is (bits, counts per
    microstrain): its counts give the default of 6122h; a third element, (counts at 0, counts at 1000 microstrain) for
    each gauge, gives those of 6120h and 6122h where they differ. With more than 16 bits INTEGER16 cannot hold
    counts, so 7100h, 7120h and 7122h are left out, and bit 9 of the product code is set.
    Raises ValueError for an ``n`` outside 3..8.
    """
    if not MIN_GAUGES <= n <= MAX_GAUGES:
        raise ValueError("number of gauges: %r, allowed %d to %d" % (n, MIN_GAUGES, MAX_GAUGES))
    found = list(_communication(product_code(n, simulated, converter), simulated))
    for pdo in rpdos():
        found += _pdo_objects("rpdo", communication.RPDO, pdo)
    for pdo in tpdos(n):
        found += _pdo_objects("tpdo", communication.TPDO, pdo)
    found += _calibration(n)
    found += _live()
    if simulated:
        found += _simulation(n)
    found += _profile(n, converter)
    return tuple(_with_sub0(row) for row in sorted(found))


def staged(n: int) -> "tuple[tuple[int, int, str], ...]":
    """The fields of the calibration record in order, as (index, sub, type)."""
    fields: list[tuple[int, int, str]] = []
    for index, _code, _name, _slug, entries in _calibration(n):
        for first, count, _label, _part, kind, _access, flags, _default, _low, _high, _unit in entries:
            if flags & STAGED:
                fields += [(index, sub, kind) for sub in range(first, first + count)]
    return tuple(fields)


def _run(index: int, first: int, last: int) -> "Mapped":
    return tuple((index, sub) for sub in range(first, last + 1))


def _with_sub0(row: "Object") -> "Object":
    index, code, name, slug, entries = row
    if code == VAR or entries[0][0] == 0:
        return row
    highest = entries[-1][0] + entries[-1][1] - 1
    count: Run = (0, 1, "Highest sub-index supported", "count", U8, "const", 0, highest, None, None, "")
    return (index, code, name, slug, (count,) + entries)


def _var(
    index: int,
    name: str,
    slug: str,
    kind: str,
    access: str,
    flags: int = 0,
    default: "Value" = 0,
    low: "Limit" = None,
    high: "Limit" = None,
    unit: str = "",
) -> "Object":
    return (index, VAR, name, slug, ((0, 1, name, slug, kind, access, flags, default, low, high, unit),))


def _array(
    index: int,
    name: str,
    slug: str,
    count: int,
    names: "str | tuple[str, ...]",
    kind: str,
    access: str,
    flags: int = 0,
    default: "Value | tuple[Value, ...]" = 0,
    low: "Limit" = None,
    high: "Limit" = None,
    unit: str = "",
) -> "Object":
    run = (1, count, names, slug, kind, access, flags, default, low, high, unit)
    return (index, ARRAY, name, slug, (run,))


def _record(index: int, name: str, slug: str, *entries: "tuple[Any, ...]") -> "Object":
    """Entries as (sub, name, slug, type, access, flags, default, low, high, unit), the tail optional."""
    filled: list[Run] = []
    for entry in entries:
        tail = (0, 0, None, None, "")[len(entry) - 5 :]
        sub, label, part, kind, access = entry[:5]
        flags, default, low, high, unit = tuple(entry[5:]) + tail
        filled.append((sub, 1, label, slug + "." + part, kind, access, flags, default, low, high, unit))
    return (index, RECORD, name, slug, tuple(filled))


# The rest is a table: one entry a line says more than one argument a line.
# fmt: off


def _communication(product: int, simulated: bool) -> "tuple[Object, ...]":
    stores = ("all parameters", "communication parameters", "application parameters", "calibration")
    return (
        _var(communication.DEVICE_TYPE, "Device type", "device_type", U32, "ro", 0, 0x00020194),
        _var(communication.ERROR_REGISTER, "Error register", "error_register", U8, "ro", TPDO),
        _var(communication.MANUFACTURER_STATUS, "Manufacturer status register", "manufacturer_status", U32, "ro", TPDO),
        (
            communication.ERROR_HISTORY,
            ARRAY,
            "Pre-defined error field",
            "error_history",
            (
                (0, 1, "Number of errors", "error_history.count", U8, "rw", NOT_STORED, 0, None, None, ""),
                (1, 8, "Error %d", "error_history", U32, "ro", 0, 0, None, None, ""),
            ),
        ),
        _var(communication.COB_ID_SYNC, "COB-ID SYNC", "sync.cob_id", U32, "rw", 0, codes.SYNC_COB_ID),
        _var(communication.SYNC_WINDOW, "Synchronous window length", "sync.window_us", U32, "rw", 0, 0, unit="us"),
        _var(
            communication.DEVICE_NAME, "Manufacturer device name", "device_name", STRING, "const", 0,
            "tipforce fingertip",
        ),
        _var(
            communication.HARDWARE_VERSION, "Manufacturer hardware version", "hardware_version", STRING, "const", 0,
            "simulated" if simulated else "1",
        ),
        _var(
            communication.SOFTWARE_VERSION, "Manufacturer software version", "software_version", STRING,
            "const", 0, SOFTWARE_VERSION,
        ),
        _var(communication.GUARD_TIME, "Guard time", "node_guarding.guard_time_ms", U16, "rw", unit="ms"),
        _var(communication.LIFE_TIME_FACTOR, "Life time factor", "node_guarding.life_time_factor", U8, "rw"),
        _array(
            communication.STORE_PARAMETERS, "Store parameters", "store", 4, tuple("Save " + s for s in stores),
            U32, "rw", NOT_STORED, 1,
        ),
        _array(
            communication.RESTORE_DEFAULTS, "Restore default parameters", "restore", 4,
            tuple("Restore " + s for s in stores),
            U32, "rw", NOT_STORED, 1,
        ),
        _var(
            communication.COB_ID_TIME, "COB-ID time stamp object", "time.cob_id", U32, "rw", 0,
            codes.TIME_CONSUMER | codes.TIME_COB_ID,
        ),
        _var(
            communication.HIGH_RESOLUTION_TIME, "High resolution time stamp", "time.high_resolution_us",
            U32, "rw", TPDO | RPDO | NOT_STORED, unit="us",
        ),
        _var(communication.COB_ID_EMCY, "COB-ID EMCY", "emcy.cob_id", U32, "rw", ADD_NODE_ID, codes.EMCY_BASE),
        _var(communication.EMCY_INHIBIT_TIME, "Inhibit time EMCY", "emcy.inhibit_100us", U16, "rw", unit="100 us"),
        _array(
            communication.CONSUMER_HEARTBEAT, "Consumer heartbeat time", "heartbeat.consumer", 4,
            "Consumer heartbeat time %d",
            U32, "rw",
        ),
        _var(
            communication.PRODUCER_HEARTBEAT, "Producer heartbeat time", "heartbeat.producer_ms", U16, "rw", 0, 1000,
            unit="ms",
        ),
        _record(
            communication.IDENTITY, "Identity object", "identity",
            (1, "Vendor-ID", "vendor", U32, "ro"),
            (2, "Product code", "product", U32, "ro", 0, product),
            (3, "Revision number", "revision", U32, "ro", 0, REVISION),
            (4, "Serial number", "serial", U32, "ro"),
        ),
        _var(
            communication.SYNC_OVERFLOW, "Synchronous counter overflow value", "sync.counter_overflow", U8, "rw",
            0, 0, 0, 240,
        ),
        _record(
            communication.VERIFY_CONFIGURATION, "Verify configuration", "verify_configuration",
            (1, "Configuration date", "date", U32, "rw"),
            (2, "Configuration time", "time", U32, "rw"),
        ),
        _var(communication.STORED_EDS, "Store EDS", "eds", DOMAIN, "ro"),
        _var(communication.EDS_FORMAT, "Store format", "eds_format", U16, "ro"),
        _array(
            communication.ERROR_BEHAVIOUR, "Error behaviour", "error_behaviour", 1, "Communication error",
            U8, "rw", 0, 0, 0, 2,
        ),
        _record(
            communication.SDO_SERVER, "SDO server parameter", "sdo_server",
            (1, "COB-ID client to server", "client_to_server", U32, "ro", ADD_NODE_ID, codes.SDO_REQUEST_BASE),
            (2, "COB-ID server to client", "server_to_client", U32, "ro", ADD_NODE_ID, codes.SDO_RESPONSE_BASE),
        ),
        _var(communication.NMT_STARTUP, "NMT startup", "nmt_startup", U32, "rw", 0, 4),
    )


def _pdo_objects(direction: str, first: int, pdo: "Pdo") -> "tuple[Object, Object]":
    number, message, base, enabled, transmission, event_ms, mapped = pdo
    slug = "%s%d" % (direction, number)
    title = "%s%d %s" % (direction.upper(), number, message.lower())
    cob_id = base | (codes.NO_RTR if direction == "tpdo" else 0) | (0 if enabled else codes.COB_ID_INVALID)
    entries: list[tuple[Any, ...]] = [
        (1, "COB-ID", "cob_id", U32, "rw", ADD_NODE_ID if base else 0, cob_id),
        (2, "Transmission type", "transmission_type", U8, "rw", 0, transmission),
    ]
    if direction == "tpdo":
        entries.append((3, "Inhibit time", "inhibit_100us", U16, "rw", 0, 0, None, None, "100 us"))
    entries.append((5, "Event timer", "event_timer_ms", U16, "rw", 0, event_ms, None, None, "ms"))
    if direction == "tpdo":
        entries.append((6, "SYNC start value", "sync_start", U8, "rw", 0, 0, 0, 240))
    bits = tuple(index << 16 | sub << 8 | mapped_bits(index) for index, sub in mapped)
    slots = bits + (0,) * (MAX_MAPPED - len(bits))
    return (
        _record(first + number - 1, title + " communication", slug, *entries),
        (
            first + communication.MAPPING + number - 1,
            RECORD,
            title + " mapping",
            slug + ".mapping",
            (
                (0, 1, "Number of mapped objects", slug + ".mapped",
                 U8, "rw", 0, len(bits), 0, MAX_MAPPED, ""),
                (1, MAX_MAPPED, "Mapped object %d", slug + ".mapping",
                 U32, "rw", 0, slots, None, None, ""),
            ),
        ),
    )


def mapped_bits(index: int) -> int:
    """Length in bits of an object that the default PDOs map."""
    return 8 if index in (communication.ERROR_REGISTER, 0x2120, 0x2121, 0x2126) else 16


def _calibration(n: int) -> "tuple[Object, ...]":
    rows = ("F1", "F2", "F3")
    matrix = tuple("C %s SG%d" % (row, k) for row in rows for k in range(1, n + 1))
    noise = tuple("Covariance SG%d SG%d" % (j, k) for j in range(1, n + 1) for k in range(j, n + 1))
    gauges = tuple("SG%d" % k for k in range(1, n + 1))
    return (
        _array(
            0x2100, "Calibration matrix C", "calibration.matrix", 3 * n, matrix,
            REAL32, "rw", STAGED, 0.0, unit="N",
        ),
        _array(
            0x2101, "Gauge offset", "calibration.offset", n, gauges, REAL32, "rw", STAGED, 0.0, unit="strain",
        ),
        _record(
            0x2102, "Calibration facts", "calibration",
            (1, "Calibration serial", "serial", U32, "rw", STAGED),
            (2, "Calibration date YYYYMMDD", "date", U32, "rw", STAGED),
            (3, "Reference temperature", "reference_temperature",
             REAL32, "rw", STAGED, 0.0, None, None, "degC"),
            (4, "Gauge layout", "layout", U8, "rw", STAGED),
            (5, "Condition number of staged C", "condition_number", REAL32, "ro", 0, 0.0),
        ),
        _record(
            0x2103, "Calibration check", "calibration",
            (1, "Expected CRC-32 of the staged record", "expected_crc", U32, "rw", NOT_STORED),
            (2, "CRC-32 of the staged record", "staged_crc", U32, "ro"),
            (3, "CRC-32 of the active record", "active_crc", U32, "ro"),
            (4, "Calibration generation", "generation", U32, "ro"),
        ),
        _var(0x2104, "Commit the staged calibration", "calibration.commit", U32, "wo"),
        _record(
            0x2105, "Calibration guard", "calibration",
            (1, "Condition limit", "condition_limit", REAL32, "rw", 0, 1e4, 1.0, 1e30),
            (2, "Write lock", "lock", U8, "rw", NOT_STORED, 0, 0, 1),
            (3, "Unlock", "unlock", U32, "wo"),
        ),
        _array(
            0x2106, "Gauge noise covariance", "calibration.noise", n * (n + 1) // 2, noise,
            REAL32, "rw", STAGED, 0.0, unit="strain^2",
        ),
        _array(
            0x2107, "Standard uncertainty", "uncertainty", 3, ("u(P) N", "u(phi) degree", "u(theta) degree"),
            REAL32, "ro", TPDO, 0.0,
        ),
        _record(
            0x2110, "Contact settings", "contact",
            (1, "Tip radius", "tip_radius", REAL32, "rw", STAGED, 0.0, None, None, "m"),
            (2, "Theta minimum", "theta_minimum", REAL32, "rw", STAGED, 0.0, None, None, "degree"),
            (3, "Theta maximum", "theta_maximum", REAL32, "rw", STAGED, 0.0, None, None, "degree"),
            (4, "Contact-on force", "on_force", REAL32, "rw", STAGED, 0.0, None, None, "N"),
            (5, "Contact-off force", "off_force", REAL32, "rw", STAGED, 0.0, None, None, "N"),
            (6, "Load sense (0 push, 1 pull)", "load_sense", U8, "rw", STAGED, 0, 0, 1),
        ),
        _record(
            0x2112, "Calibration validity", "calibration",
            (1, "Calibrated force (0 not known)", "calibrated_force",
             REAL32, "rw", STAGED, 0.0, None, None, "N"),
            (2, "Overload force (0 not known)", "overload_force",
             REAL32, "rw", STAGED, 0.0, None, None, "N"),
            (3, "Lowest temperature", "temperature_minimum",
             REAL32, "rw", STAGED, 0.0, None, None, "degC"),
            (4, "Highest temperature (both 0 not known)", "temperature_maximum",
             REAL32, "rw", STAGED, 0.0, None, None, "degC"),
            (5, "Relative model uncertainty of the force", "model_uncertainty", REAL32, "rw", STAGED, 0.0),
        ),
        _array(
            0x2113, "Converter limit (0 span alone)", "calibration.converter_limit", n, gauges,
            REAL32, "rw", STAGED, 0.0, unit="strain",
        ),
        _array(
            0x2114, "Offset against temperature", "calibration.offset_temperature", n, gauges,
            REAL32, "rw", STAGED, 0.0, unit="strain/K",
        ),
        _var(
            0x2115, "Gain of the force against temperature", "calibration.gain_temperature",
            REAL32, "rw", STAGED, 0.0, unit="1/K",
        ),
        _var(
            0x2116, "Limit of the redundancy check (0 off)", "calibration.redundancy_limit",
            REAL32, "rw", STAGED, 0.0,
        ),
    )


def _live() -> "tuple[Object, ...]":
    return (
        _record(
            0x2111, "Tare", "tare",
            (1, "Applied tare F1", "F1", REAL32, "ro", 0, 0.0, None, None, "N"),
            (2, "Applied tare F2", "F2", REAL32, "ro", 0, 0.0, None, None, "N"),
            (3, "Applied tare F3", "F3", REAL32, "ro", 0, 0.0, None, None, "N"),
            (4, "Age of the tare", "age_s", U32, "ro", 0, 0, None, None, "s"),
        ),
        _var(0x2120, "Status byte", "status", U8, "ro", TPDO),
        _var(0x2121, "Sample counter", "counter", U8, "ro", TPDO),
        _var(0x2122, "Temperature", "temperature", I16, "ro", TPDO, UNKNOWN_I16, unit="0.01 degC"),
        _var(0x2123, "Standard uncertainty of P", "u_P", U16, "ro", TPDO, UNKNOWN_U16, unit="mN"),
        _var(0x2124, "Front-end faults", "faults", U16, "ro", TPDO),
        _var(0x2126, "Configuration counter", "configuration_counter", U8, "ro", TPDO),
        _var(0x2130, "Command", "command", U16, "rw", RPDO | NOT_STORED, 0, 0, COMMAND_ZERO),
        _var(0x2140, "Active calibration record", "calibration.active_record", DOMAIN, "ro"),
        _var(0x2141, "Staged calibration record", "calibration.staged_record", DOMAIN, "rw", NOT_STORED),
    )


def _simulation(n: int) -> "tuple[Object, ...]":
    return (
        _record(
            0x2200, "Simulated fault", "simulation",
            (1, "Fault", "fault", U16, "rw", NOT_STORED, 0, 0, 5),
            (2, "Gauge", "gauge", U8, "rw", NOT_STORED, 1, 1, n),
            (3, "Magnitude", "magnitude", REAL32, "rw", NOT_STORED, 0.0),
        ),
        _record(
            0x2201, "Simulated load", "simulation",
            (1, "P", "P", REAL32, "rw", NOT_STORED, 0.0, None, None, "N"),
            (2, "phi", "phi", REAL32, "rw", NOT_STORED, 0.0, None, None, "degree"),
            (3, "theta", "theta", REAL32, "rw", NOT_STORED, 0.0, None, None, "degree"),
        ),
    )


def _profile(n: int, converter: "Converter") -> "list[Object]":
    chans = channels(n)
    symbols = tuple(c[0] for c in chans)
    total = n + 6

    def single(
        index: int, name: str, slug: str, count: int, kind: str, access: str, flags: int = 0,
        default: "Value | tuple[Value, ...]" = 0, low: "Limit" = None, high: "Limit" = None, unit: str = "",
    ) -> "Object":
        names = symbols[:count]
        return _array(index, name, slug, count, names, kind, access, flags, default, low, high, unit)

    found: list[Object] = [
        single(0x6110, "AI sensor type", "sensor_type", total, U16, "ro", 0, tuple(c[4] for c in chans)),
        single(0x6112, "AI operating mode", "operating_mode", total, U8, "rw", 0, 1, 1, 1),
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
        single(0x61A0, "AI filter type", "filter_type", n, U8, "rw", 0, 0, 0, 100),
        single(0x61A1, "AI filter constant", "filter_constant", n, U16, "rw", 0, 1, 1, 65535),
    ]
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
        found.append(
            _array(
                0x6000 + offset, "AI " + name, slug, count, symbols[:count], REAL32, access, flags,
                default if isinstance(default, float) else default[:count], unit=unit,
            )
        )
        for form, kind, suffix in ((INT16_FORM, I16, "int16"), (INT32_FORM, I32, "int32")):
            if kind == I16 and unit == "counts" and converter[0] > 16:
                continue
            found.append(
                _array(
                    0x6000 + form + offset, "AI " + name + " " + suffix, slug + "_" + suffix, count, symbols[:count],
                    kind, access, flags | VIEW, _scaled(default, digits),
                    unit=unit if unit == "counts" else "resolution of 6132h",
                )
            )
    return found


def _scaled(default: "float | tuple[float, ...]", digits: "tuple[int, ...]") -> "tuple[int, ...]":
    """The integer form of REAL32 defaults: times ten to the 6132h digits of each channel."""
    values = (default,) * len(digits) if isinstance(default, float) else default
    return tuple(round(values[k] * 10 ** digits[k]) for k in range(len(digits)))
