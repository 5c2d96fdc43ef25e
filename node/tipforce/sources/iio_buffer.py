"""Buffered capture of Linux Industrial I/O: a trigger starts each scan; the kernel time-stamps and stores it. The
sequence follows the kernel's documentation (iio/iio_devbuf, iio/iio_configfs): select the channels in
``scan_elements``, name the trigger, enable the buffer, read whole scans from ``/dev/iio:deviceN``. A scan holds the
enabled channels in the order of their index, each aligned to its own size, the 64-bit time stamp last.
"""

import contextlib
import os
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from tipforce.errors import EnvironmentLackError
from tipforce.sources import iio_sysfs
from tipforce.sources.iio_sysfs import Device, PolledDevice, ScanType

DEVICE_FILES = Path("/dev")
HRTIMER = Path("/sys/kernel/config/iio/triggers/hrtimer")
CLOCK = "monotonic"  # of the time stamps: the node's own clock, independent of the time of day
_KEPT_SCANS = 1024  # in the kernel, and as many here: a loop that is suspended longer loses the oldest
_STAMP = "timestamp"


class TimestampError(OSError):
    """Two scans whose time stamps do not increase: the capture has stopped or repeats itself."""


class Layout(NamedTuple):
    """Positions of the wanted channels and of the time stamp in a scan."""

    size: int
    channels: tuple[tuple[int, ScanType], ...]
    """(offset in bytes, type) of each wanted channel, in the order wanted."""
    stamp: tuple[int, ScanType] | None


def layout_of(types: Sequence[tuple[str, int, ScanType]], wanted: Sequence[str]) -> Layout:
    """Return the layout of a scan of (channel, index, type), all of them enabled."""
    offsets: dict[str, tuple[int, ScanType]] = {}
    end, widest = 0, 1
    for channel, _index, kind in sorted(types, key=lambda entry: entry[1]):
        size = kind.storage_bits // 8
        end += -end % size
        offsets[channel] = end, kind
        end += size
        widest = max(widest, size)
    return Layout(end + -end % widest, tuple(offsets[channel] for channel in wanted), offsets.get(_STAMP))


def value_of(scan: bytes, offset: int, kind: ScanType) -> int:
    """Return one channel of a scan: shifted, masked to its bits, sign-extended."""
    stored = scan[offset : offset + kind.storage_bits // 8]
    value = int.from_bytes(stored, "big" if kind.big_endian else "little") >> kind.shift & (1 << kind.bits) - 1
    return value - (1 << kind.bits) if kind.signed and value >> kind.bits - 1 else value


class BufferedDevice(PolledDevice):
    """Channels of one device through its buffer; ``trigger`` is a name, or empty.

    ``read`` returns the newest scan up to the requested time (by monotonic time stamps), so that a filter that catches
    up processes each scan once. Raises EnvironmentLackError if the device has no buffer or the kernel rejects the
    set-up.
    """

    polled = False
    _fd = -1

    def __init__(
        self, device: Device, channels: Sequence[str], trigger: str, device_files: Path = DEVICE_FILES
    ) -> None:
        self._trigger, self._device_files = trigger, device_files
        try:
            super().__init__(device, channels)
        except OSError as error:
            raise EnvironmentLackError(
                f"iio {device}: buffered capture cannot be set up: {error}; run as root, or use `--capture poll`"
            ) from error

    def reopen(self) -> None:
        """Set up and start the capture. Raises OSError while the device is missing."""
        self.close()
        super().reopen()
        self._write("buffer/enable", "0")
        self._layout = layout_of(self._enabled(), self.channels)
        with contextlib.suppress(OSError):  # older kernels have only one clock, the time of day
            self._write("current_timestamp_clock", CLOCK)
        clock = iio_sysfs.text_of(self.path / "current_timestamp_clock")
        self._monotonic = self._layout.stamp is not None and clock == CLOCK
        if self._trigger:
            self._write("trigger/current_trigger", self._trigger)
        with contextlib.suppress(OSError):
            self._write("buffer/length", str(_KEPT_SCANS))
        self._fd = os.open(self._device_files / self.path.name, os.O_RDONLY | os.O_NONBLOCK)
        self._write("buffer/enable", "1")
        self._rest, self._stamp_ns = b"", -1
        self._scans: deque[tuple[int, tuple[int, ...]]] = deque(maxlen=_KEPT_SCANS)

    def _enabled(self) -> list[tuple[str, int, ScanType]]:
        """Enable the wanted channels of the scan and disable the others; return name, index and type of the former."""
        elements = self.path / "scan_elements"
        names = sorted(entry.name[3:-3] for entry in elements.glob("in_*_en"))
        missing = [channel for channel in self.channels if channel not in names]
        if missing:
            raise OSError(2, f"channel {missing[0]} is not in scan_elements")
        enabled = []
        for channel in names:
            wanted = channel in self.channels or channel == _STAMP
            self._write(f"scan_elements/in_{channel}_en", "1" if wanted else "0")
            if wanted:
                kind = iio_sysfs.scan_type(self.path, channel)
                if kind is None or kind.storage_bits not in (8, 16, 32, 64):
                    raise OSError(22, f"in_{channel}_type has an unknown format")
                enabled.append((channel, int((elements / f"in_{channel}_index").read_text()), kind))
        return enabled

    def _write(self, name: str, text: str) -> None:
        iio_sysfs.write_attribute(self.path / name, text)

    def read(self, now_us: int) -> tuple[int, ...] | None:
        """Return the newest scan up to ``now_us``, or None if there was none since the last call. Raises OSError if the
        device is removed, TimestampError for time stamps that do not increase."""
        if not self.path.is_dir():
            raise FileNotFoundError(2, "No such device")
        size = self._layout.size
        with contextlib.suppress(BlockingIOError):
            while data := os.read(self._fd, size * 64):
                data = self._rest + data
                whole = len(data) - len(data) % size
                self._rest = data[whole:]  # an incomplete scan waits for the rest
                for at in range(0, whole, size):
                    self._take(data[at : at + size])
        newest = None
        while self._scans and (not self._monotonic or self._scans[0][0] <= now_us):
            newest = self._scans.popleft()[1]
        return newest

    def _take(self, scan: bytes) -> None:
        stamp_us = 0
        if self._layout.stamp is not None:
            stamp_ns = value_of(scan, *self._layout.stamp)
            if stamp_ns <= self._stamp_ns:
                before, self._stamp_ns = self._stamp_ns, stamp_ns
                self._scans.clear()
                raise TimestampError(5, f"time stamp {stamp_ns} ns after {before} ns")
            self._stamp_ns, stamp_us = stamp_ns, stamp_ns // 1000
        self._scans.append((stamp_us, tuple([value_of(scan, *place) for place in self._layout.channels])))

    def close(self) -> None:
        """Stop the capture."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
            with contextlib.suppress(OSError):
                self._write("buffer/enable", "0")


def triggers(root: Path = iio_sysfs.ROOT) -> dict[str, Path]:
    """Return the triggers of the bus by name."""
    by_name = {}
    for entry in sorted(root.glob("trigger*")):
        with contextlib.suppress(OSError):
            by_name[(entry / "name").read_text().strip()] = entry
    return by_name


def own_trigger(device: Device, root: Path = iio_sysfs.ROOT) -> str | None:
    """Return the data-ready trigger of a device, which drivers name ``NAME-devN``; None if it has none."""
    number = device.number.removeprefix("iio:device")
    names = [name for name in triggers(root) if name.endswith(f"-dev{number}") and name.startswith(device.name)]
    return names[0] if names else None


def make_hrtimer(name: str, frequency_hz: float, root: Path = iio_sysfs.ROOT, configfs: Path = HRTIMER) -> str:
    """Return a high-resolution timer trigger of that name and rate, existing or created through configfs. Raises
    EnvironmentLackError if the kernel has no such triggers, or rejects the request."""
    try:
        if not configfs.is_dir():
            raise FileNotFoundError(2, f"{configfs} is missing")
        (configfs / name).mkdir(exist_ok=True)
        iio_sysfs.write_attribute(triggers(root)[name] / "sampling_frequency", f"{frequency_hz:.0f}")
    except (OSError, KeyError) as error:
        raise EnvironmentLackError(
            f"hrtimer trigger: {error}; as root: `modprobe iio-trig-hrtimer` and "
            "`mount -t configfs none /sys/kernel/config`, or `--capture poll`"
        ) from error
    return name
