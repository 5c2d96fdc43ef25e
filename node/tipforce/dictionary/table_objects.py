"""The objects of a fingertip's dictionary in the form of ``table``: 1000h (CiA 301), 2100h, and 6000h (CiA 404) on."""

from canopen_device.core import codes
from canopen_device.core import communication as at
from tipforce.dictionary import indices as own

# isort: off
# fmt: off
from tipforce.dictionary.table import (
    ADD_NODE_ID, ARRAY, COMMAND_ZERO, CONVERTER_16, COUNTED, DOMAIN, I16, I32, INT16_FORM, INT32_FORM, MAX_GAUGES,
    MAX_MAPPED, MIN_GAUGES, NOT_STORED, REAL32, RECORD, REVISION, RPDO, SOFTWARE_VERSION, STAGED, STRING, TPDO, U8, U16,
    U32, UNKNOWN_I16, UNKNOWN_U16, VAR, VIEW, array, channels, mapped_bits, product_code, record, rpdos, run, tpdos,
    var,
)
# fmt: on
# isort: on

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any

    from tipforce.dictionary.table import Converter, Object, Pdo


def objects(
    n: int = 3, simulated: bool = False, converter: "Converter" = CONVERTER_16, programs: bool = False
) -> "tuple[Object, ...]":
    """Every object of a node with ``n`` gauges, by index. Raises ValueError for an ``n`` outside 3..8.

    ``simulated`` adds 2200h, 2201h and bit 8 of the product code. ``converter`` is (bits, counts per microstrain:
    6122h), with a third element (counts at 0, at 1000 microstrain) per gauge. Above 16 bits 7100h, 7120h and 7122h,
    whose INTEGER16 cannot hold counts, are left out, and bit 9 of the product code is set."""
    return tuple(sorted(declared(n, simulated, converter, programs)))


def declared(n: int, simulated: bool, converter: "Converter", programs: bool = False) -> "Iterator[Object]":
    """The same one by one, in no order: a microcontroller has no heap for all of them at once."""
    if not MIN_GAUGES <= n <= MAX_GAUGES:
        raise ValueError("number of gauges: %r, allowed %d to %d" % (n, MIN_GAUGES, MAX_GAUGES))
    for index, code, name, slug, entries in _areas(n, simulated, converter, programs):
        highest = entries[-1][0] + entries[-1][1] - 1
        count = (run(0, 1, "Highest sub-index supported", "count", U8, "const", 0, highest),)
        yield (index, code, name, slug, entries if code == VAR or entries[0][0] == 0 else count + entries)


def _areas(n: int, simulated: bool, converter: "Converter", programs: bool) -> "Iterator[Object]":
    yield from communication_area(product_code(n, simulated, converter), simulated)
    for pdo in rpdos():
        yield from pdo_objects("rpdo", at.RPDO, pdo)
    for pdo in tpdos(n):
        yield from pdo_objects("tpdo", at.TPDO, pdo)
    yield from calibration(n)
    yield from live()
    yield from program_slots() if programs else ()
    yield from simulation(n) if simulated else ()
    yield from profile(n, converter)


def staged(n: int) -> "tuple[tuple[int, int, str], ...]":
    """The fields of the calibration record in order, as (index, sub, type)."""
    fields: list[tuple[int, int, str]] = []
    for index, _code, _name, _slug, entries in calibration(n):
        for first, count, _label, _part, kind, _access, flags, _default, _low, _high, _unit in entries:
            if flags & STAGED:
                fields += [(index, sub, kind) for sub in range(first, first + count)]
    return tuple(fields)


# A table: one entry a line says more than one argument a line.
# fmt: off


def communication_area(product: int, simulated: bool) -> "tuple[Object, ...]":
    """Objects 1000h to 1FFFh but the PDOs and programs (CiA 301)."""
    stores = ("all parameters", "communication parameters", "application parameters", "calibration")
    return (
        var(at.DEVICE_TYPE, "Device type", "device_type", U32, "ro", 0, 0x00020194),
        var(at.ERROR_REGISTER, "Error register", "error_register", U8, "ro", TPDO),
        var(at.MANUFACTURER_STATUS, "Manufacturer status register", "manufacturer_status", U32, "ro", TPDO),
        (at.ERROR_HISTORY, ARRAY, "Pre-defined error field", "error_history", (
            run(0, 1, "Number of errors", "error_history.count", U8, "rw", NOT_STORED),
            run(1, 8, "Error %d", "error_history", U32, "ro"),
        )),
        var(at.COB_ID_SYNC, "COB-ID SYNC", "sync.cob_id", U32, "rw", COUNTED, codes.SYNC_COB_ID),
        var(at.SYNC_WINDOW, "Synchronous window length", "sync.window_us", U32, "rw", 0, 0, unit="us"),
        var(at.DEVICE_NAME, "Manufacturer device name", "device_name", STRING, "const", 0, "tipforce fingertip"),
        var(at.HARDWARE_VERSION, "Manufacturer hardware version", "hardware_version", STRING, "const", 0,
            "simulated" if simulated else "1"),
        var(at.SOFTWARE_VERSION, "Manufacturer software version", "software_version", STRING, "const", 0,
            SOFTWARE_VERSION),
        var(at.GUARD_TIME, "Guard time", "node_guarding.guard_time_ms", U16, "rw", unit="ms"),
        var(at.LIFE_TIME_FACTOR, "Life time factor", "node_guarding.life_time_factor", U8, "rw"),
        array(at.STORE_PARAMETERS, "Store parameters", "store", 4, tuple("Save " + s for s in stores), U32, "rw",
            NOT_STORED, 1),
        array(at.RESTORE_DEFAULTS, "Restore default parameters", "restore", 4, tuple("Restore " + s for s in stores),
            U32, "rw", NOT_STORED, 1),
        var(at.COB_ID_TIME, "COB-ID time stamp object", "time.cob_id", U32, "rw", 0,
            codes.TIME_CONSUMER | codes.TIME_COB_ID),
        var(at.HIGH_RESOLUTION_TIME, "High resolution time stamp", "time.high_resolution_us", U32, "rw",
            TPDO | RPDO | NOT_STORED, unit="us"),
        var(at.COB_ID_EMCY, "COB-ID EMCY", "emcy.cob_id", U32, "rw", ADD_NODE_ID | COUNTED, codes.EMCY_BASE),
        var(at.EMCY_INHIBIT_TIME, "Inhibit time EMCY", "emcy.inhibit_100us", U16, "rw", unit="100 us"),
        array(at.CONSUMER_HEARTBEAT, "Consumer heartbeat time", "heartbeat.consumer", 4, "Consumer heartbeat time %d",
            U32, "rw"),
        var(at.PRODUCER_HEARTBEAT, "Producer heartbeat time", "heartbeat.producer_ms", U16, "rw", COUNTED, 1000,
            unit="ms"),
        record(at.IDENTITY, "Identity object", "identity",
            (1, "Vendor-ID", "vendor", U32, "ro"),
            (2, "Product code", "product", U32, "ro", 0, product),
            (3, "Revision number", "revision", U32, "ro", 0, REVISION),
            (4, "Serial number", "serial", U32, "ro")),
        var(at.SYNC_OVERFLOW, "Synchronous counter overflow value", "sync.counter_overflow", U8, "rw", COUNTED, 0, 0,
            240),
        record(at.VERIFY_CONFIGURATION, "Verify configuration", "verify_configuration",
            (1, "Configuration date", "date", U32, "rw"),
            (2, "Configuration time", "time", U32, "rw")),
        var(at.STORED_EDS, "Store EDS", "eds", DOMAIN, "ro"),
        var(at.EDS_FORMAT, "Store format", "eds_format", U16, "ro"),
        array(at.ERROR_BEHAVIOUR, "Error behaviour", "error_behaviour", 1, "Communication error", U8, "rw", 0, 0, 0, 2),
        record(at.SDO_SERVER, "SDO server parameter", "sdo_server",
            (1, "COB-ID client to server", "client_to_server", U32, "ro", ADD_NODE_ID, codes.SDO_REQUEST_BASE),
            (2, "COB-ID server to client", "server_to_client", U32, "ro", ADD_NODE_ID, codes.SDO_RESPONSE_BASE)),
        var(at.NMT_STARTUP, "NMT startup", "nmt_startup", U32, "rw", 0, 4),
    )


def pdo_objects(direction: str, first: int, pdo: "Pdo") -> "tuple[Object, Object]":
    """Communication and mapping parameters of a PDO."""
    number, message, base, enabled, transmission, event_ms, mapped = pdo
    slug = "%s%d" % (direction, number)
    title = "%s%d %s" % (direction.upper(), number, message.lower())
    counted = COUNTED if direction == "tpdo" else 0
    cob_id = base | (codes.NO_RTR if direction == "tpdo" else 0) | (0 if enabled else codes.COB_ID_INVALID)
    entries: list[tuple[Any, ...]] = [
        (1, "COB-ID", "cob_id", U32, "rw", counted | (ADD_NODE_ID if base else 0), cob_id),
        (2, "Transmission type", "transmission_type", U8, "rw", counted, transmission),
    ]
    if direction == "tpdo":
        entries.append((3, "Inhibit time", "inhibit_100us", U16, "rw", counted, 0, None, None, "100 us"))
    entries.append((5, "Event timer", "event_timer_ms", U16, "rw", counted, event_ms, None, None, "ms"))
    if direction == "tpdo":
        entries.append((6, "SYNC start value", "sync_start", U8, "rw", counted, 0, 0, 240))
    bits = tuple(index << 16 | sub << 8 | mapped_bits(index) for index, sub in mapped)
    slots = bits + (0,) * (MAX_MAPPED - len(bits))
    return (
        record(first + number - 1, title + " communication", slug, *entries),
        (first + at.MAPPING + number - 1, RECORD, title + " mapping", slug + ".mapping", (
            run(0, 1, "Number of mapped objects", slug + ".mapped", U8, "rw", counted, len(bits), 0, MAX_MAPPED),
            run(1, MAX_MAPPED, "Mapped object %d", slug + ".mapping", U32, "rw", counted, slots),
        )),
    )


def program_slots() -> "tuple[Object, ...]":
    """CiA 302-3; the values of 1F51h and 1F57h are in ``canopen_device.core.program``."""
    return (
        array(at.PROGRAM_DATA, "Program data", "program.data", 1, "Program number %d", DOMAIN, "wo"),
        array(at.PROGRAM_CONTROL, "Program control", "program.control", 1, "Program number %d", U8, "rw", NOT_STORED, 1,
            0, 3),
        array(at.PROGRAM_IDENTIFICATION, "Program software identification", "program.identification", 1,
            "Program number %d", U32, "ro"),
        array(at.FLASH_STATUS, "Flash status", "program.flash_status", 1, "Program number %d", U32, "ro"),
    )


def calibration(n: int) -> "tuple[Object, ...]":
    """Calibration, its record and where it is valid, for n gauges."""
    rows = ("F1", "F2", "F3")
    matrix = tuple("C %s SG%d" % (row, k) for row in rows for k in range(1, n + 1))
    noise = tuple("Covariance SG%d SG%d" % (j, k) for j in range(1, n + 1) for k in range(j, n + 1))
    gauges = tuple("SG%d" % k for k in range(1, n + 1))
    return (
        array(own.CALIBRATION_MATRIX, "Calibration matrix C", "calibration.matrix", 3 * n, matrix, REAL32, "rw", STAGED,
            0.0, unit="N"),
        array(own.CALIBRATION_OFFSET, "Gauge offset", "calibration.offset", n, gauges, REAL32, "rw", STAGED, 0.0,
            unit="strain"),
        record(own.CALIBRATION_FACTS, "Calibration facts", "calibration",
            (1, "Calibration serial", "serial", U32, "rw", STAGED),
            (2, "Calibration date YYYYMMDD", "date", U32, "rw", STAGED),
            (3, "Reference temperature", "reference_temperature", REAL32, "rw", STAGED, 0.0, None, None, "degC"),
            (4, "Gauge layout", "layout", U8, "rw", STAGED),
            (5, "Condition number of staged C", "condition_number", REAL32, "ro", 0, 0.0)),
        record(own.CALIBRATION_CHECK, "Calibration check", "calibration",
            (1, "Expected CRC-32 of the staged record", "expected_crc", U32, "rw", NOT_STORED),
            (2, "CRC-32 of the staged record", "staged_crc", U32, "ro"),
            (3, "CRC-32 of the active record", "active_crc", U32, "ro"),
            (4, "Calibration generation", "generation", U32, "ro")),
        var(own.CALIBRATION_COMMIT, "Commit the staged calibration", "calibration.commit", U32, "wo"),
        record(own.CALIBRATION_GUARD, "Calibration guard", "calibration",
            (1, "Condition limit", "condition_limit", REAL32, "rw", 0, 1e4, 1.0, 1e30),
            (2, "Write lock", "lock", U8, "rw", NOT_STORED, 0, 0, 1),
            (3, "Unlock", "unlock", U32, "wo")),
        array(own.CALIBRATION_NOISE, "Gauge noise covariance", "calibration.noise", n * (n + 1) // 2, noise, REAL32,
            "rw", STAGED, 0.0, unit="strain^2"),
        array(own.UNCERTAINTY, "Standard uncertainty", "uncertainty", 3, ("u(P) N", "u(phi) degree", "u(theta) degree"),
            REAL32, "ro", TPDO, 0.0),
        record(own.CONTACT_SETTINGS, "Contact settings", "contact",
            (1, "Tip radius", "tip_radius", REAL32, "rw", STAGED, 0.0, None, None, "m"),
            (2, "Theta minimum", "theta_minimum", REAL32, "rw", STAGED, 0.0, None, None, "degree"),
            (3, "Theta maximum", "theta_maximum", REAL32, "rw", STAGED, 0.0, None, None, "degree"),
            (4, "Contact-on force", "on_force", REAL32, "rw", STAGED, 0.0, None, None, "N"),
            (5, "Contact-off force", "off_force", REAL32, "rw", STAGED, 0.0, None, None, "N"),
            (6, "Load sense (0 push, 1 pull)", "load_sense", U8, "rw", STAGED, 0, 0, 1)),
        record(own.CALIBRATION_VALIDITY, "Calibration validity", "calibration",
            (1, "Calibrated force (0 not known)", "calibrated_force", REAL32, "rw", STAGED, 0.0, None, None, "N"),
            (2, "Overload force (0 not known)", "overload_force", REAL32, "rw", STAGED, 0.0, None, None, "N"),
            (3, "Lowest temperature", "temperature_minimum", REAL32, "rw", STAGED, 0.0, None, None, "degC"),
            (4, "Highest temperature (both 0 not known)", "temperature_maximum",
             REAL32, "rw", STAGED, 0.0, None, None, "degC"),
            (5, "Relative model uncertainty of the force", "model_uncertainty", REAL32, "rw", STAGED, 0.0)),
        array(own.CALIBRATION_CONVERTER_LIMIT, "Converter limit (0 span alone)", "calibration.converter_limit", n,
            gauges, REAL32, "rw", STAGED, 0.0, unit="strain"),
        array(own.CALIBRATION_OFFSET_TEMPERATURE, "Offset against temperature", "calibration.offset_temperature", n,
            gauges, REAL32, "rw", STAGED, 0.0, unit="strain/K"),
        var(own.CALIBRATION_GAIN_TEMPERATURE, "Gain of the force against temperature", "calibration.gain_temperature",
            REAL32, "rw", STAGED, 0.0, unit="1/K"),
        var(own.CALIBRATION_REDUNDANCY_LIMIT, "Limit of the redundancy check (0 off)", "calibration.redundancy_limit",
            REAL32, "rw", STAGED, 0.0),
    )


def live() -> "tuple[Object, ...]":
    """Live values: tare, contact, force and their uncertainty."""
    return (
        record(own.TARE, "Tare", "tare",
            (1, "Applied tare F1", "F1", REAL32, "ro", 0, 0.0, None, None, "N"),
            (2, "Applied tare F2", "F2", REAL32, "ro", 0, 0.0, None, None, "N"),
            (3, "Applied tare F3", "F3", REAL32, "ro", 0, 0.0, None, None, "N"),
            (4, "Age of the tare", "age_s", U32, "ro", 0, 0, None, None, "s")),
        var(own.STATUS, "Status byte", "status", U8, "ro", TPDO),
        var(own.COUNTER, "Sample counter", "counter", U8, "ro", TPDO),
        var(own.TEMPERATURE, "Temperature", "temperature", I16, "ro", TPDO, UNKNOWN_I16, unit="0.01 degC"),
        var(own.U_P, "Standard uncertainty of P", "u_P", U16, "ro", TPDO, UNKNOWN_U16, unit="mN"),
        var(own.FAULTS, "Front-end faults", "faults", U16, "ro", TPDO),
        var(own.CONFIGURATION_COUNTER, "Configuration counter", "configuration_counter", U8, "ro", TPDO),
        var(own.COMMAND, "Command", "command", U16, "rw", RPDO | NOT_STORED, 0, 0, COMMAND_ZERO),
        var(own.CALIBRATION_ACTIVE_RECORD, "Active calibration record", "calibration.active_record", DOMAIN, "ro"),
        var(own.CALIBRATION_STAGED_RECORD, "Staged calibration record", "calibration.staged_record", DOMAIN, "rw",
            NOT_STORED),
    )


def simulation(n: int) -> "tuple[Object, ...]":
    """Settings of a simulated node."""
    return (
        record(own.SIMULATED_FAULT, "Simulated fault", "simulation",
            (1, "Fault", "fault", U16, "rw", NOT_STORED, 0, 0, 5),
            (2, "Gauge", "gauge", U8, "rw", NOT_STORED, 1, 1, n),
            (3, "Magnitude", "magnitude", REAL32, "rw", NOT_STORED, 0.0)),
        record(own.SIMULATED_LOAD, "Simulated load", "simulation",
            (1, "P", "P", REAL32, "rw", NOT_STORED, 0.0, None, None, "N"),
            (2, "phi", "phi", REAL32, "rw", NOT_STORED, 0.0, None, None, "degree"),
            (3, "theta", "theta", REAL32, "rw", NOT_STORED, 0.0, None, None, "degree")),
    )


def profile(n: int, converter: "Converter") -> "Iterator[Object]":
    """Objects of CiA 404 for each gauge channel."""
    chans = channels(n)
    symbols = tuple(c[0] for c in chans)
    total = n + 6

    def single(index: int, name: str, slug: str, count: int, *rest: "Any") -> "Object":
        return array(index, name, slug, count, symbols[:count], *rest)

    yield from (
        single(own.SENSOR_TYPE, "AI sensor type", "sensor_type", total, U16, "ro", 0, tuple(c[4] for c in chans)),
        single(own.OPERATING_MODE, "AI operating mode", "operating_mode", total, U8, "rw", COUNTED, 1, 1, 1),
        single(own.SAMPLE_PERIOD_US, "AI sample period", "sample_period_us", total, U32, "rw", 0, 500, 100, 1000000,
            "us"),
        single(own.AUTOZERO, "AI autozero", "autozero", n, U32, "wo"),
        single(own.UNIT, "AI physical unit", "unit", total, U32, "ro", 0, tuple(c[2] for c in chans)),
        single(own.DECIMAL_DIGITS, "AI decimal digits", "decimal_digits", total,
            U8, "ro", 0, tuple(c[3] for c in chans)),
        (own.AUTOTARE, ARRAY, "AI autotare", "autotare", (
            run(0, 1, "Highest sub-index supported", "count", U8, "const", 0, n + 1),
            run(n + 1, 1, "F1, F2, F3", "autotare", U32, "wo"),
        )),
        single(own.CHANNEL_STATUS, "AI status", "channel_status", total, U8, "ro", TPDO),
        single(own.FILTER_TYPE, "AI filter type", "filter_type", n, U8, "rw", COUNTED, 0, 0, 100),
        single(own.FILTER_CONSTANT, "AI filter constant", "filter_constant", n, U16, "rw", COUNTED, 1, 1, 65535),
    )
    zero: "float | tuple[float, ...]" = 0.0
    full: "float | tuple[float, ...]" = 1000.0 * converter[1]
    if len(converter) > 2:
        zero, full = tuple(points[0] for points in converter[2]), tuple(points[1] for points in converter[2])
    lows, highs, process = tuple(c[6] for c in chans), tuple(c[7] for c in chans), "unit of 6131h"
    # One value in three forms: REAL32 (6xxxh, the value itself), INTEGER16 and INTEGER32 (views).
    for index, name, slug, count, access, default, unit in (
        (own.FIELD_VALUE, "field value", "field_value", n, "ro", 0.0, "counts"),
        (own.SCALING_1_FIELD, "scaling 1 field value", "scaling_1_field", n, "rw", zero, "counts"),
        (own.SCALING_1_PROCESS, "scaling 1 process value", "scaling_1_process", n, "rw", 0.0, "microstrain"),
        (own.SCALING_2_FIELD, "scaling 2 field value", "scaling_2_field", n, "rw", full, "counts"),
        (own.SCALING_2_PROCESS, "scaling 2 process value", "scaling_2_process", n, "rw", 1000.0, "microstrain"),
        (own.PROCESS_OFFSET, "process value offset", "process_offset", n, "rw", 0.0, "microstrain"),
        (own.PROCESS_VALUE, "process value", "process_value", total, "ro", 0.0, process),
        (own.INTERRUPT_DELTA, "interrupt delta", "interrupt_delta", total, "rw", 0.0, process),
        (own.INTERRUPT_LOWER, "interrupt lower limit", "interrupt_lower", total, "rw", lows, process),
        (own.INTERRUPT_UPPER, "interrupt upper limit", "interrupt_upper", total, "rw", highs, process),
        (own.INTERRUPT_HYSTERESIS, "interrupt hysteresis", "interrupt_hysteresis", total, "rw", 0.0, process),
        (own.SPAN_START, "span start", "span_start", total, "rw", lows, process),
        (own.SPAN_END, "span end", "span_end", total, "rw", highs, process),
    ):
        flags = TPDO if access == "ro" else 0
        digits = tuple(0 if unit == "counts" else c[3] for c in chans[:count])
        values = default[:count] if isinstance(default, tuple) else (default,) * count
        yield array(index, "AI " + name, slug, count, symbols[:count], REAL32, access,
            flags if access == "ro" else COUNTED, default if isinstance(default, float) else values, unit=unit)
        for form, kind, suffix in ((INT16_FORM, I16, "int16"), (INT32_FORM, I32, "int32")):
            if kind == I16 and unit == "counts" and converter[0] > 16:
                continue
            # The integer form of a default: times ten to the 6132h digits of its channel.
            yield array(index + form, "AI " + name + " " + suffix, slug + "_" + suffix, count, symbols[:count],
                kind, access, flags | VIEW, tuple(round(values[k] * 10 ** digits[k]) for k in range(count)),
                unit=unit if unit == "counts" else "resolution of 6132h")
