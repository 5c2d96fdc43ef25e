"""The fingertip's own area of its dictionary: calibration, tare and live values, and the simulation, 2100h to 2201h."""

from tipforce.dictionary.table import (
    COMMAND_ZERO,
    DOMAIN,
    I16,
    NOT_STORED,
    REAL32,
    RPDO,
    STAGED,
    TPDO,
    U8,
    U16,
    U32,
    UNKNOWN_I16,
    UNKNOWN_U16,
    array,
    record,
    var,
)

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.dictionary.table import Object

# A table: one entry a line says more than one argument a line.
# fmt: off


def calibration(n: int) -> "tuple[Object, ...]":
    """Calibration, its record and where it is valid, for n gauges."""
    rows = ("F1", "F2", "F3")
    matrix = tuple("C %s SG%d" % (row, k) for row in rows for k in range(1, n + 1))
    noise = tuple("Covariance SG%d SG%d" % (j, k) for j in range(1, n + 1) for k in range(j, n + 1))
    gauges = tuple("SG%d" % k for k in range(1, n + 1))
    return (
        array(
            0x2100, "Calibration matrix C", "calibration.matrix", 3 * n, matrix,
            REAL32, "rw", STAGED, 0.0, unit="N",
        ),
        array(
            0x2101, "Gauge offset", "calibration.offset", n, gauges, REAL32, "rw", STAGED, 0.0, unit="strain",
        ),
        record(
            0x2102, "Calibration facts", "calibration",
            (1, "Calibration serial", "serial", U32, "rw", STAGED),
            (2, "Calibration date YYYYMMDD", "date", U32, "rw", STAGED),
            (3, "Reference temperature", "reference_temperature",
             REAL32, "rw", STAGED, 0.0, None, None, "degC"),
            (4, "Gauge layout", "layout", U8, "rw", STAGED),
            (5, "Condition number of staged C", "condition_number", REAL32, "ro", 0, 0.0),
        ),
        record(
            0x2103, "Calibration check", "calibration",
            (1, "Expected CRC-32 of the staged record", "expected_crc", U32, "rw", NOT_STORED),
            (2, "CRC-32 of the staged record", "staged_crc", U32, "ro"),
            (3, "CRC-32 of the active record", "active_crc", U32, "ro"),
            (4, "Calibration generation", "generation", U32, "ro"),
        ),
        var(0x2104, "Commit the staged calibration", "calibration.commit", U32, "wo"),
        record(
            0x2105, "Calibration guard", "calibration",
            (1, "Condition limit", "condition_limit", REAL32, "rw", 0, 1e4, 1.0, 1e30),
            (2, "Write lock", "lock", U8, "rw", NOT_STORED, 0, 0, 1),
            (3, "Unlock", "unlock", U32, "wo"),
        ),
        array(
            0x2106, "Gauge noise covariance", "calibration.noise", n * (n + 1) // 2, noise,
            REAL32, "rw", STAGED, 0.0, unit="strain^2",
        ),
        array(
            0x2107, "Standard uncertainty", "uncertainty", 3, ("u(P) N", "u(phi) degree", "u(theta) degree"),
            REAL32, "ro", TPDO, 0.0,
        ),
        record(
            0x2110, "Contact settings", "contact",
            (1, "Tip radius", "tip_radius", REAL32, "rw", STAGED, 0.0, None, None, "m"),
            (2, "Theta minimum", "theta_minimum", REAL32, "rw", STAGED, 0.0, None, None, "degree"),
            (3, "Theta maximum", "theta_maximum", REAL32, "rw", STAGED, 0.0, None, None, "degree"),
            (4, "Contact-on force", "on_force", REAL32, "rw", STAGED, 0.0, None, None, "N"),
            (5, "Contact-off force", "off_force", REAL32, "rw", STAGED, 0.0, None, None, "N"),
            (6, "Load sense (0 push, 1 pull)", "load_sense", U8, "rw", STAGED, 0, 0, 1),
        ),
        record(
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
        array(
            0x2113, "Converter limit (0 span alone)", "calibration.converter_limit", n, gauges,
            REAL32, "rw", STAGED, 0.0, unit="strain",
        ),
        array(
            0x2114, "Offset against temperature", "calibration.offset_temperature", n, gauges,
            REAL32, "rw", STAGED, 0.0, unit="strain/K",
        ),
        var(
            0x2115, "Gain of the force against temperature", "calibration.gain_temperature",
            REAL32, "rw", STAGED, 0.0, unit="1/K",
        ),
        var(
            0x2116, "Limit of the redundancy check (0 off)", "calibration.redundancy_limit",
            REAL32, "rw", STAGED, 0.0,
        ),
    )


def live() -> "tuple[Object, ...]":
    """Live values: tare, contact, force and their uncertainty."""
    return (
        record(
            0x2111, "Tare", "tare",
            (1, "Applied tare F1", "F1", REAL32, "ro", 0, 0.0, None, None, "N"),
            (2, "Applied tare F2", "F2", REAL32, "ro", 0, 0.0, None, None, "N"),
            (3, "Applied tare F3", "F3", REAL32, "ro", 0, 0.0, None, None, "N"),
            (4, "Age of the tare", "age_s", U32, "ro", 0, 0, None, None, "s"),
        ),
        var(0x2120, "Status byte", "status", U8, "ro", TPDO),
        var(0x2121, "Sample counter", "counter", U8, "ro", TPDO),
        var(0x2122, "Temperature", "temperature", I16, "ro", TPDO, UNKNOWN_I16, unit="0.01 degC"),
        var(0x2123, "Standard uncertainty of P", "u_P", U16, "ro", TPDO, UNKNOWN_U16, unit="mN"),
        var(0x2124, "Front-end faults", "faults", U16, "ro", TPDO),
        var(0x2126, "Configuration counter", "configuration_counter", U8, "ro", TPDO),
        var(0x2130, "Command", "command", U16, "rw", RPDO | NOT_STORED, 0, 0, COMMAND_ZERO),
        var(0x2140, "Active calibration record", "calibration.active_record", DOMAIN, "ro"),
        var(0x2141, "Staged calibration record", "calibration.staged_record", DOMAIN, "rw", NOT_STORED),
    )


def simulation(n: int) -> "tuple[Object, ...]":
    """Settings of a simulated node."""
    return (
        record(
            0x2200, "Simulated fault", "simulation",
            (1, "Fault", "fault", U16, "rw", NOT_STORED, 0, 0, 5),
            (2, "Gauge", "gauge", U8, "rw", NOT_STORED, 1, 1, n),
            (3, "Magnitude", "magnitude", REAL32, "rw", NOT_STORED, 0.0),
        ),
        record(
            0x2201, "Simulated load", "simulation",
            (1, "P", "P", REAL32, "rw", NOT_STORED, 0.0, None, None, "N"),
            (2, "phi", "phi", REAL32, "rw", NOT_STORED, 0.0, None, None, "degree"),
            (3, "theta", "theta", REAL32, "rw", NOT_STORED, 0.0, None, None, "degree"),
        ),
    )
