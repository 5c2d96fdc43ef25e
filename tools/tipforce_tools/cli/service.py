"""What a command needs that runs for months: real-time scheduling, locked memory, systemd's notices, journal levels."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import signal
import socket
import time
from collections.abc import Callable

from tipforce.errors import EnvironmentLackError, InputError

_LOG = logging.getLogger(__name__)
_MCL_CURRENT, _MCL_FUTURE = 1, 2  # sys/mman.h
_SYSLOG = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}


def set_priority(priority: int) -> None:
    """Schedule this process SCHED_FIFO with ``priority`` (1 to 99), before every ordinary process.

    Raises InputError for another number, EnvironmentLackError where the system has it not or does not allow it.
    """
    if not 1 <= priority <= 99:
        raise InputError(f"--priority {priority}: allowed are 1 to 99 (above 50 it runs before interrupt threads)")
    if not hasattr(os, "sched_setscheduler"):
        raise EnvironmentLackError("--priority: this system has no SCHED_FIFO; leave the flag out")
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError as error:
        raise EnvironmentLackError(
            f"--priority {priority}: not permitted; run as root, or let the unit say LimitRTPRIO={priority}, "
            f"or put `USER - rtprio {priority}` into /etc/security/limits.conf and log in again"
        ) from error
    except OSError as error:
        raise EnvironmentLackError(f"--priority {priority}: {error.strerror}") from error


def lock_memory() -> None:
    """Keep all pages of this process in memory, those to come too. Raises EnvironmentLackError."""
    call = getattr(ctypes.CDLL(None, use_errno=True), "mlockall", None)
    if call is None:
        raise EnvironmentLackError("--lock-memory: this system has no mlockall; leave the flag out")
    if call(_MCL_CURRENT | _MCL_FUTURE) != 0:
        number = ctypes.get_errno()
        error = OSError(number, os.strerror(number))  # a PermissionError where that is the reason
        reason = "not permitted" if isinstance(error, PermissionError) else os.strerror(number)
        raise EnvironmentLackError(
            f"--lock-memory: {reason}; run as root, or let the unit say LimitMEMLOCK=infinity, "
            "or put `USER - memlock unlimited` into /etc/security/limits.conf and log in again"
        ) from (error if isinstance(error, PermissionError) else PermissionError(number, reason))


class Notifier:
    """systemd's notices (sd_notify) over the socket that NOTIFY_SOCKET names; does nothing where there is none.

    ``alive`` sends the watchdog's notice at half of WATCHDOG_USEC and may be called as often as one likes.
    """

    def __init__(self, clock_us: Callable[[], int] = lambda: time.monotonic_ns() // 1000) -> None:
        address = os.environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if self._address else None
        if self._socket is not None:
            self._socket.setblocking(False)
        self._clock_us = clock_us
        self._period_us = self._watchdog_us() // 2
        self._next_us = 0

    @staticmethod
    def _watchdog_us() -> int:
        """0 without a watchdog, and where it watches another process."""
        if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
            return 0
        text = os.environ.get("WATCHDOG_USEC", "")
        return int(text) if text.isdecimal() else 0

    def send(self, *lines: str) -> None:
        """Send lines such as READY=1. A manager that does not read loses them; the node goes on."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto("\n".join(lines).encode(), self._address)

    def alive(self) -> None:
        """WATCHDOG=1, if it is time."""
        if self._period_us and self._clock_us() >= self._next_us:
            self._next_us = self._clock_us() + self._period_us
            self.send("WATCHDOG=1")

    def close(self) -> None:
        """Release the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class StopSignal:
    """True once SIGTERM or SIGINT came, so that a loop ends between two steps and never inside a write.

    A second SIGINT interrupts at once.
    """

    def __init__(self) -> None:
        self.came = False
        self._before = {number: signal.signal(number, self._note) for number in (signal.SIGTERM, signal.SIGINT)}

    def _note(self, number: int, _frame: object) -> None:
        if self.came and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.came = True

    def __call__(self) -> bool:
        """Has one come?"""
        return self.came

    def restore(self) -> None:
        """Give the signals back."""
        for number, handler in self._before.items():
            signal.signal(number, handler)


class _JournalFormatter(logging.Formatter):
    """``<4>message``: the journal takes the number for the level (sd-daemon), and stamps the time itself."""

    def format(self, record: logging.LogRecord) -> str:
        level = _SYSLOG.get(record.levelno, 6)
        return "\n".join(f"<{level}>{line}" for line in super().format(record).splitlines())


def mark_levels_for_journal() -> None:
    """Where stderr is systemd's journal (JOURNAL_STREAM), log with its levels."""
    device, _, inode = os.environ.get("JOURNAL_STREAM", "").partition(":")
    try:
        status = os.fstat(2)
    except OSError:
        return
    if device and (device, inode) == (str(status.st_dev), str(status.st_ino)):
        for handler in logging.getLogger().handlers:
            handler.setFormatter(_JournalFormatter("%(name)s: %(message)s"))
