"""Support for long-running services: real-time scheduling, locked memory, sd_notify, journal levels."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import logging
import os
import signal
import socket
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from canopen_device.running import loop
from tipforce.errors import EnvironmentLackError, InputError
from tipforce_tools.cli import common
from tipforce_tools.cli.listening import StopSignals

if TYPE_CHECKING:
    from canopen_device.core.node import Device
    from canopen_device.running.loop import Port, Runnable

_NOT_PERMITTED = (
    "{}; run as root, or set {} in the unit, or add `USER - {}` to /etc/security/limits.conf and log in again"
)
_MCL_CURRENT, _MCL_FUTURE = 1, 2  # sys/mman.h
_SYSLOG = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}


def set_priority(priority: int) -> None:
    """Schedule this process SCHED_FIFO with ``priority`` (1 to 99), ahead of every ordinary process. Raises InputError
    for another number, EnvironmentLackError if the system lacks or does not permit SCHED_FIFO."""
    if not 1 <= priority <= 99:
        raise InputError(f"--priority {priority}: allowed are 1 to 99 (above 50 it runs before interrupt threads)")
    if not hasattr(os, "sched_setscheduler"):
        raise EnvironmentLackError("--priority: this system has no SCHED_FIFO; leave the flag out")
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError as error:
        flag, limits = f"--priority {priority}: not permitted", (f"LimitRTPRIO={priority}", f"rtprio {priority}")
        raise EnvironmentLackError(_NOT_PERMITTED.format(flag, *limits)) from error
    except OSError as error:
        raise EnvironmentLackError(f"--priority {priority}: {error.strerror}") from error


def lock_memory() -> None:
    """Lock all present and future pages of this process in memory. Raises EnvironmentLackError."""
    call = getattr(ctypes.CDLL(None, use_errno=True), "mlockall", None)
    if call is None:
        raise EnvironmentLackError("--lock-memory: this system has no mlockall; leave the flag out")
    if call(_MCL_CURRENT | _MCL_FUTURE) != 0:
        number = ctypes.get_errno()
        reason = "not permitted" if number == errno.EPERM else os.strerror(number)
        text = _NOT_PERMITTED.format(f"--lock-memory: {reason}", "LimitMEMLOCK=infinity", "memlock unlimited")
        raise EnvironmentLackError(text) from PermissionError(number, reason)


class Notifier:
    """Send systemd notifications (sd_notify) to the socket in NOTIFY_SOCKET; does nothing without that variable.
    ``alive`` sends the watchdog notification at half of WATCHDOG_USEC and may be called at any rate."""

    def __init__(self, clock_us: Callable[[], int] = lambda: time.monotonic_ns() // 1000) -> None:
        address = os.environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if self._address else None
        self._clock_us = clock_us
        own, text = str(os.getpid()), os.environ.get("WATCHDOG_USEC", "")
        supervised = os.environ.get("WATCHDOG_PID", own) == own and text.isdecimal()
        self._period_us = int(text) // 2 if supervised else 0
        self._next_us = 0

    def send(self, *lines: str) -> None:
        """Send lines such as READY=1. Does not wait: a manager that does not read loses them."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto("\n".join(lines).encode(), socket.MSG_DONTWAIT, self._address)

    def alive(self) -> None:
        """Send WATCHDOG=1 if it is due."""
        if self._period_us and self._clock_us() >= self._next_us:
            self._next_us = self._clock_us() + self._period_us
            self.send("WATCHDOG=1")

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class _JournalFormatter(logging.Formatter):
    """Format ``<4>message``: the journal reads the number as the level (sd-daemon) and adds the time."""

    def format(self, record: logging.LogRecord) -> str:
        level = _SYSLOG.get(record.levelno, 6)
        return "\n".join(f"<{level}>{line}" for line in super().format(record).splitlines())


def mark_levels_for_journal() -> None:
    """Log with the journal's levels if stderr is the systemd journal (JOURNAL_STREAM)."""
    device, _, inode = os.environ.get("JOURNAL_STREAM", "").partition(":")
    try:
        status = os.fstat(2)
    except OSError:
        return
    if device and (device, inode) == (str(status.st_dev), str(status.st_ino)):
        for handler in logging.getLogger().handlers:
            handler.setFormatter(_JournalFormatter("%(name)s: %(message)s"))


def serve(who: str, what: str, devices: Sequence[Runnable], nodes: Sequence[Device], port: Port) -> None:
    """Run ``devices`` until a signal; report start and end to the service manager, the bus and the terminal. ``nodes``
    are those that report STOPPED at the end."""
    notifier = Notifier()

    def ended() -> bool:
        notifier.alive()
        return stop()

    with StopSignals((signal.SIGINT,)) as stop:
        try:
            common.note(f"{who}: {what}; Ctrl-C ends it")
            notifier.send("READY=1", f"STATUS={who}: {what}")
            loop.run(devices, port, ended)
        except KeyboardInterrupt:
            pass
        finally:
            notifier.send("STOPPING=1", f"STATUS={who} stopped")
            loop.say_stopped(nodes, port)
            notifier.close()
    common.note(f"{who}: stopped")
