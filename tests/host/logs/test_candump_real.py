"""candump's own output, recorded: can-utils 2020.11 on vcan, one run, all flags listening to the same frames."""

import os
import time
from collections.abc import Iterator

import numpy as np
import pytest

from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.logs.candump import CandumpParser
from tipforce.host.logs.candump_format import CandumpFormat
from tools.blocks import block_of_text

LOG = """\
(1795254996.104918) vcan0 285#2E1129239A110303
(1795254997.205379) vcan0 181#0102
(1795254997.225794) vcan0 080#
(1795254998.326292) vcan0 181#R8
(1795254998.346786) vcan0 182#R
(1795254999.447280) vcan0 20000004#0004000000000000
(1795255000.547743) vcan0 200001FF#053FFF1934006080
(1795255001.648231) vcan0 20000040#
(1795255002.748719) vcan0 20000200#0000000000000708
(1795255002.770299) vcan0 2000000C#00400000
(1795255002.771546) vcan0 12345678#0001020304050607
(1795255003.871947) vcan0 00000123#FF
(1795255003.873311) vcan0 00000123#R3
(1795255003.874477) vcan0 7FF#41414141414141
(1795255003.875636) vcan0 123#
"""

STAMPS = """\
000.000000 000.000000 36.104918
001.100461 001.100461 37.205379
001.120876 000.020415 37.225794
002.221374 001.100498 38.326292
002.241868 000.020494 38.346786
003.342362 001.100494 39.447280
004.442825 001.100463 40.547743
005.543313 001.100488 41.648231
006.643801 001.100488 42.748719
006.665381 000.021580 42.770299
006.666628 000.001247 42.771546
007.767029 001.100401 43.871947
007.768393 000.001364 43.873311
007.769559 000.001166 43.874477
007.770718 000.001159 43.875636
"""
"""In front of each line, with -tz, -td, and -tA from the seconds on."""

ERRORS = """\
  vcan0  285   [8]  2E 11 29 23 9A 11 03 03
  vcan0  181   [2]  01 02
  vcan0  080   [0]\x20
  vcan0  181   [8]  remote request
  vcan0  182   [0]  remote request
  vcan0  20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME
\tcontroller-problem{rx-error-warning}
  vcan0  200001FF   [8]  05 3F FF 19 34 00 60 80   ERRORFRAME
\ttx-timeout
\tlost-arbitration{at bit 5}
\tcontroller-problem{rx-overflow,tx-overflow,rx-error-warning,tx-error-warning,rx-error-passive,tx-error-passive}
\tprotocol-violation{{single-bit-error,frame-format-error,bit-stuffing-error,tx-dominant-bit-error,tx-recessive-bit-error,bus-overload,active-error,error-on-tx}{acknowledge-slot}}
\ttransceiver-status
\tno-acknowledgement-on-tx
\tbus-off
\tbus-error
\trestarted-after-bus-off
\terror-counter-tx-rx{{96}{128}}
  vcan0  20000040   [0]                            ERRORFRAME
\tbus-off
  vcan0  20000200   [8]  00 00 00 00 00 00 07 08   ERRORFRAME
\t
\terror-counter-tx-rx{{7}{8}}
  vcan0  2000000C   [4]  00 40 00 00               ERRORFRAME
\tcontroller-problem{back-to-error-active}
\tprotocol-violation{{}{}}
  vcan0  12345678   [8]  00 01 02 03 04 05 06 07
  vcan0  00000123   [1]  FF
  vcan0  00000123   [3]  remote request
  vcan0       7FF   [7]  41 41 41 41 41 41 41
  vcan0       123   [0]\x20
"""

SCREEN = [line for line in ERRORS.splitlines() if not line.startswith("\t")]
EXTRA = "".join(line.replace("vcan0", "vcan0  TX - -", 1) + "\n" for line in SCREEN)
FROM_ZERO, DELTAS, DATES = (
    "".join(f" ({minute}{stamp}){line}\n" for stamp, line in zip(stamps, SCREEN, strict=True))
    for minute, stamps in zip(
        ("", "", "2026-11-21 09:56:"), zip(*map(str.split, STAMPS.splitlines()), strict=True), strict=True
    )
)

TEXTS = ("'..)#....'", "'..'", "''", *7 * [""], "'........'", "'.'", "", "'AAAAAAA'", "''")
"""Behind each line, with -a."""
ASCII = "".join(
    f"{line:{line.index(']') + 29}}{text}".rstrip() + "\n" for line, text in zip(SCREEN, TEXTS, strict=True)
)


def two_interfaces(lines: list[str], first: str, last: str) -> str:
    """The first and the last five lines, and two of an interface with a long name, which widens what follows it."""
    widened = [line.replace("vcan0", f"{'vcan0':>15}", 1) for line in lines[-5:]]
    return "\n".join((*lines[:5], first, *widened, last, ""))


LOG_TWO_INTERFACES = two_interfaces(
    LOG.splitlines(),
    "(1795255002.749962) vcan_long_name1 182#68656C6C6F",
    "(1795255003.896026) vcan_long_name1 183#68656C6C6F",
)
TWO_INTERFACES = two_interfaces(
    SCREEN, "  vcan_long_name1  182   [5]  68 65 6C 6C 6F", "  vcan_long_name1       183   [5]  68 65 6C 6C 6F"
)

COLOUR = """\
  \x1b[1m\x1b[34mvcan0  285   [8]  2E 11 29 23 9A 11 03 03\x1b[0m
  \x1b[1m\x1b[34mvcan0  181   [2]  01 02\x1b[0m
  \x1b[1m\x1b[34mvcan0  080   [0] \x1b[0m
  \x1b[1m\x1b[34mvcan0  181   [8]  remote request\x1b[0m
"""


def parsed(text: str, *, deltas: bool = False) -> CandumpBlock:
    return block_of_text(text, CandumpParser(strict=True, deltas=deltas))


def formatted(block: CandumpBlock, timestamps: str = "", *, log: bool = False, errors: bool = False) -> str:
    return "\n".join(CandumpFormat(timestamps, log=log, errors=errors).lines(block)) + "\n"


@pytest.fixture
def utc(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    before = os.environ.get("TZ")
    monkeypatch.setenv("TZ", "UTC")
    time.tzset()
    yield
    if before is None:
        monkeypatch.delenv("TZ")
    else:
        monkeypatch.setenv("TZ", before)
    time.tzset()


@pytest.mark.parametrize(("timestamps", "text"), [("z", FROM_ZERO), ("d", DELTAS), ("A", DATES)])
@pytest.mark.usefixtures("utc")
def test_screen_with_timestamps(timestamps: str, text: str) -> None:
    assert formatted(parsed(LOG), timestamps) == text


def test_log_and_absolute_timestamps() -> None:
    assert formatted(parsed(LOG), log=True) == LOG
    screen = formatted(parsed(LOG), "a").splitlines()
    plain = formatted(parsed(LOG)).splitlines()
    assert screen == [f" {log.split()[0]} {line[1:]}" for log, line in zip(LOG.splitlines(), plain, strict=True)]


def test_extra_and_errors() -> None:
    sent = "".join(line + " T\n" for line in LOG.splitlines())
    assert "\n".join(CandumpFormat(extra=True).lines(parsed(sent))) + "\n" == EXTRA
    assert "\n".join(CandumpFormat(extra=True, log=True).lines(parsed(sent))) + "\n" == sent
    assert formatted(parsed(LOG), errors=True) == ERRORS


def test_two_interfaces_align_and_a_long_identifier_indents() -> None:
    assert formatted(parsed(LOG_TWO_INTERFACES)) == TWO_INTERFACES
    assert formatted(parsed(LOG_TWO_INTERFACES), log=True) == LOG_TWO_INTERFACES


@pytest.mark.parametrize("text", [EXTRA, ERRORS, ASCII, FROM_ZERO])
def test_every_screen_format_reads_as_the_log_does(text: str) -> None:
    block, log = parsed(text), parsed(LOG)
    for field in ("can_id", "length", "data"):
        np.testing.assert_array_equal(block.frames[field], log.frames[field])
    assert block.names == ("vcan0",)
    assert block.frames["flags"].all() == (text is EXTRA)
    assert block.timed == (text is FROM_ZERO)


def test_colour_is_no_part_of_a_line() -> None:
    np.testing.assert_array_equal(parsed(COLOUR).frames["can_id"], parsed(LOG).frames["can_id"][:4])


@pytest.mark.usefixtures("utc")
def test_timestamps_are_exact() -> None:
    log = parsed(LOG).frames["t_ns"]
    assert log[0] == 1795254996_104918000
    np.testing.assert_array_equal(parsed(DATES).frames["t_ns"], log)
    np.testing.assert_array_equal(parsed(FROM_ZERO).frames["t_ns"], log - log[0])
    np.testing.assert_array_equal(parsed(DELTAS, deltas=True).frames["t_ns"], log - log[0])
