"""Linux Industrial I/O through sysfs: the present converters, their channels, scales and raw values. The kernel's
contract is Documentation/ABI/testing/sysfs-bus-iio: (raw + offset) * scale is in millivolts for a voltage and in
thousandths of a degree Celsius for a temperature. All functions take the root directory, so that a test can pass its
own. They raise OSError if the kernel returns an error, and InputError for a name that matches nothing.
"""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from tipforce.errors import EnvironmentLackError, InputError

ROOT = Path("/sys/bus/iio/devices")
_RAW = re.compile(r"in_(voltage\d*(?:-voltage\d+)?(?:_[a-z]\w*?)?)_raw")
_TEMPERATURE = re.compile(r"in_(temp\d*)_(?:raw|input)")
_SCAN_TYPE = re.compile(r"(be|le):([su])(\d+)/(\d+)(?:X(\d+))?(?:>>(\d+))?")
UNKNOWN_TEMPERATURE = -0x8000


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
        """Return the number and the other names of the device."""
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
            return float((path / file).read_text())
        except FileNotFoundError:
            continue
        except ValueError:
            raise OSError(5, f"{file} holds no number") from None
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
    channels: tuple[str, ...]
    _temperature: str | None = None
    """The channel of a temperature."""

    def __init__(self, device: Device, channels: Sequence[str]) -> None:
        self.path, self.name, self.channels = device.path, device.number, tuple(channels)
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
            return UNKNOWN_TEMPERATURE
        try:
            given = self.attribute(self._temperature, "input")
            hundredths = 0.1 * (self.quantity(self._temperature, 1.0) if given is None else given)
        except OSError:
            return UNKNOWN_TEMPERATURE
        return round(hundredths) if -32767.5 < hundredths < 32767.5 else UNKNOWN_TEMPERATURE

    def close(self) -> None:
        """Release the device; here no file stays open."""


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
