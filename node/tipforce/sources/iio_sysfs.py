"""Linux Industrial I/O through sysfs: the present converters, their channels, scales, raw values and buffers.

Documentation/ABI/testing/sysfs-bus-iio: (raw + offset) * scale is in mV or in 0.001 degC; iio/iio_devbuf, iio_configfs:
a trigger starts each scan, which holds the enabled channels by index, each aligned to its size, the 64-bit time stamp
last. All functions raise OSError if the kernel returns an error."""

import contextlib
import os
import re
from collections import deque
from collections.abc import Sequence
from itertools import product
from math import isfinite
from pathlib import Path
from typing import NamedTuple

from tipforce.dictionary import table
from tipforce.errors import EnvironmentLackError, InputError

ROOT = Path("/sys/bus/iio/devices")
_RAW = re.compile(r"in_(voltage\d*(?:-voltage\d+)?(?:_[a-z]\w*?)?)_raw")
_TEMPERATURE = re.compile(r"in_(temp\d*)_(?:raw|input)")
_SCAN_TYPE = re.compile(r"(be|le):([su])([1-9]\d*)/(\d+)(?:X(\d+))?(?:>>(\d+))?")
DEVICE_FILES = Path("/dev")
HRTIMER = Path("/sys/kernel/config/iio/triggers/hrtimer")
CLOCK = "monotonic"  # of the time stamps: the node's own clock, independent of the time of day
_KEPT_SCANS = 1024  # in the kernel, and as many here: a loop that is suspended longer loses the oldest
_STAMP = "timestamp"


class Device(NamedTuple):
    """One device of the bus."""

    number: str
    """``iio:device0``: the kernel numbers devices in the order in which they appear."""
    name: str
    """The driver's name; several devices may have the same name."""
    label: str
    """The device tree's label, empty if there is none."""
    place: str
    """Where it is connected, such as ``0-0050`` (bus 0, address 50h): constant when numbers change."""
    path: Path
    """The real directory, place included: another device that gets the same number has another path."""

    def __str__(self) -> str:
        others = dict.fromkeys(word for word in (self.name, self.label, self.place) if word)
        return f"{self.number} ({', '.join(others)})" if others else self.number


class ScanType(NamedTuple):
    """Format of a channel in a scan, such as ``le:u12/16>>0``."""

    big_endian: bool
    signed: bool
    bits: int
    storage_bits: int
    shift: int

    @property
    def ends(self) -> tuple[int, int]:
        """The lowest and the highest raw value."""
        return (-(1 << self.bits - 1), (1 << self.bits - 1) - 1) if self.signed else (0, (1 << self.bits) - 1)


def devices(root: Path = ROOT) -> list[Device]:
    """Return all devices (no triggers), by number; empty if the kernel has no Industrial I/O."""
    present = []
    for entry in root.glob("iio:device*"):
        path = Path(os.path.realpath(entry))
        present.append(Device(entry.name, text_of(path / "name"), text_of(path / "label"), path.parent.name, path))
    return sorted(present, key=lambda device: _natural(device.number))


def find(wanted: str, root: Path = ROOT) -> Device:
    """The device of a number, name, label or place. Raises InputError for several, EnvironmentLackError for none."""
    present = devices(root)
    number = f"iio:{wanted}" if re.fullmatch(r"device\d+", wanted) else wanted
    exact = [device for device in present if device.number == number]
    fitting = exact or [device for device in present if wanted in (device.name, device.label, device.place)]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise InputError(f"iio {wanted!r}: matches {'; '.join(map(str, fitting))}; select one by number or place")
    there = "; ".join(map(str, present)) or "none: `tipforce doctor` reports what is missing"
    raise EnvironmentLackError(f"iio {wanted!r}: no such device; allowed: {there}")


def voltage_channels(path: Path) -> list[str]:
    """Return the names of the voltage channels: ``voltage0``, ``voltage0-voltage1``, or ``voltage`` of an only one."""
    names = (_RAW.fullmatch(entry.name) for entry in path.iterdir())
    return sorted((match[1] for match in names if match), key=_natural)


def raw_value(path: Path, channel: str) -> int:
    """Return one conversion in counts. Raises OSError, with EIO for a text that is not a number."""
    file = f"in_{channel}_raw"
    fd = os.open(path / file, os.O_RDONLY)
    try:
        return int(os.read(fd, 64))
    except ValueError:
        raise OSError(5, f"{file} holds no number") from None
    finally:
        os.close(fd)


def attribute(path: Path, channel: str, name: str) -> float | None:
    """Return such as ``scale`` of a channel, its own or the shared one; None if there is none. Raises OSError if the
    kernel has the file and rejects the read: EINVAL means an unknown reference."""
    kind = re.sub(r"\d+", "", channel)
    for file in (f"in_{channel}_{name}", f"in_{kind}_{name}", f"in_{name}"):
        try:
            if isfinite(value := float((path / file).read_text())):
                return value
        except FileNotFoundError:
            continue
        except ValueError:
            pass
        raise OSError(5, f"{file} holds no number")
    return None


def scan_type(path: Path, channel: str) -> ScanType | None:
    """Return the format of the channel in a scan; None if the driver offers no buffer."""
    for folder in ("scan_elements", "buffer0"):
        text = text_of(path / folder / f"in_{channel}_type")
        match = _SCAN_TYPE.fullmatch(text)
        if match and match[5] in (None, "1"):
            order, sign, bits, storage, _repeat, shift = match.groups()
            return ScanType(order == "be", sign == "s", int(bits), int(storage), int(shift or 0))
    return None


class PolledDevice:
    """Channels of one device, read one after the other on request: each read waits for a conversion."""

    polled = True
    """True if ``read`` starts the conversion, False if the device converts on its own."""
    name: str
    channels: tuple[str, ...] = ()
    _temperature: str | None = None
    """The channel of a temperature."""

    def __init__(self, device: Device, channels: Sequence[str]) -> None:
        self.path, self.name, self.channels = device.path, device.number, tuple(channels)
        self._scales: dict[tuple[str, str], float | None] = {}
        self.reopen()

    def reopen(self) -> None:
        """Find the device again at the same place: its number may change, its place does not. Raises OSError while
        there is none there, or if there are several and none has the old number."""
        if not self.path.is_dir():
            present = sorted(self.path.parent.glob("iio:device*"))
            if len(present) != 1:
                raise FileNotFoundError(2, "No such device")
            self.path = present[0]
        matches = (_TEMPERATURE.fullmatch(entry.name) for entry in self.path.iterdir())
        self._temperature = min((match[1] for match in matches if match), default=None)
        self.check_scales()

    def check_scales(self) -> None:
        """Raise OSError for a scale or an offset that is another than at the first call: counts mean another strain."""
        for place in product(self.channels, ("scale", "offset")):
            try:
                value = self.attribute(*place)
            except OSError:  # some are not readable, or not during a capture
                continue
            if value != self._scales.setdefault(place, value):
                raise OSError(5, f"{' '.join(place)} is {value}, was {self._scales[place]}")

    def read(self, _now_us: int) -> tuple[int, ...] | None:
        """Return new counts of all channels, or None. Raises OSError if the device is removed or does not respond."""
        return tuple([raw_value(self.path, channel) for channel in self.channels])

    def attribute(self, channel: str, name: str) -> float | None:
        """Return such as ``scale`` of a channel, None if it has none. Raises OSError."""
        return attribute(self.path, channel, name)

    def quantity(self, channel: str, default_scale: float | None = None) -> float:
        """Return (raw + offset) * scale. Raises OSError, with EINVAL if there is no scale."""
        raw, offset, scale = (self.attribute(channel, name) for name in ("raw", "offset", "scale"))
        scale = default_scale if scale is None else scale
        if raw is None or scale is None:
            raise OSError(22, f"in_{channel}_scale is missing")
        return (raw + (offset or 0.0)) * scale

    def temperature(self) -> int:
        """Return the temperature in 0.01 degC as in 2122h; unknown beyond INTEGER16 and where the read fails."""
        if self._temperature is None:
            return table.UNKNOWN_I16
        try:
            given = self.attribute(self._temperature, "input")
            hundredths = 0.1 * (self.quantity(self._temperature, 1.0) if given is None else given)
        except OSError:
            return table.UNKNOWN_I16
        return round(hundredths) if -32767.5 < hundredths < 32767.5 else table.UNKNOWN_I16

    def close(self) -> None:
        """Release the device; here no file stays open."""


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
    """A device through its buffer; ``trigger`` may be empty. Raises EnvironmentLackError if it has none, or refuses."""

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
        clock = text_of(self.path / "current_timestamp_clock")
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
                kind = scan_type(self.path, channel)
                if kind is None or kind.storage_bits not in (8, 16, 32, 64):
                    raise OSError(22, f"in_{channel}_type has an unknown format")
                enabled.append((channel, int((elements / f"in_{channel}_index").read_text()), kind))
        return enabled

    def _write(self, name: str, text: str) -> None:
        write_attribute(self.path / name, text)

    def read(self, now_us: int) -> tuple[int, ...] | None:
        """Return the newest scan up to ``now_us``, so that a filter that catches up gets each once; None without a new
        one. Raises OSError if the device is removed, TimestampError for time stamps that do not increase."""
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


def triggers(root: Path = ROOT) -> dict[str, Path]:
    """Return the triggers of the bus by name."""
    by_name = {}
    for entry in sorted(root.glob("trigger*")):
        with contextlib.suppress(OSError):
            by_name[(entry / "name").read_text().strip()] = entry
    return by_name


def own_trigger(device: Device, root: Path = ROOT) -> str | None:
    """Return the data-ready trigger of a device, which drivers name ``NAME-devN``; None if it has none."""
    number = device.number.removeprefix("iio:device")
    names = [name for name in triggers(root) if name.endswith(f"-dev{number}") and name.startswith(device.name)]
    return names[0] if names else None


def make_hrtimer(name: str, frequency_hz: float, root: Path = ROOT, configfs: Path = HRTIMER) -> str:
    """Return a high-resolution timer trigger of that name and rate, existing or created through configfs. Raises
    EnvironmentLackError if the kernel has no such triggers, or rejects the request."""
    try:
        if not configfs.is_dir():
            raise FileNotFoundError(2, f"{configfs} is missing")
        (configfs / name).mkdir(exist_ok=True)
        write_attribute(triggers(root)[name] / "sampling_frequency", f"{frequency_hz:.3f}".rstrip("0").rstrip("."))
    except (OSError, KeyError) as error:
        raise EnvironmentLackError(
            f"hrtimer trigger: {error}; as root: `modprobe iio-trig-hrtimer` and "
            "`mount -t configfs none /sys/kernel/config`, or `--capture poll`"
        ) from error
    return name


def text_of(file: Path) -> str:
    """Return the text of a file; empty if it cannot be read."""
    try:
        return file.read_text(errors="replace").strip()
    except OSError:
        return ""


def write_attribute(file: Path, text: str) -> None:
    """Write a file of sysfs, which either has it or not: it is never created. Raises OSError."""
    fd = os.open(file, os.O_WRONLY | os.O_TRUNC)
    try:
        os.write(fd, text.encode())
    finally:
        os.close(fd)


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a sort key that puts device10 after device9."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
