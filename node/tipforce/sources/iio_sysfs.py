"""Linux Industrial I/O as sysfs shows it: which converters there are, their channels, scales and raw values.

The kernel's contract is Documentation/ABI/testing/sysfs-bus-iio: (raw + offset) * scale is in millivolts for a voltage
and in thousandths of a degree Celsius for a temperature. All functions take the root, so that a test can hand in a
tree of its own. They raise OSError where the kernel gives an error, and InputError for a name that fits nothing.
"""

from __future__ import annotations

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
    """``iio:device0``: the kernel gives it in the order of appearance."""
    name: str
    """What the driver calls itself; several devices may have one name."""
    label: str
    """The device tree's label, empty if there is none."""
    place: str
    """Where it is plugged in, such as ``0-0050`` (bus 0, address 50h): it stays when numbers change."""
    path: Path
    """The real directory, place included: another device that gets the same number has another path."""

    def __str__(self) -> str:
        """The number, and what else it answers to."""
        others = dict.fromkeys(word for word in (self.name, self.label, self.place) if word)
        return f"{self.number} ({', '.join(others)})" if others else self.number


class ScanType(NamedTuple):
    """How a channel lies in a scan, of the form ``le:u12/16>>0``."""

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
    """All devices (no triggers), by number; empty where the kernel has no Industrial I/O."""
    found = []
    for entry in root.glob("iio:device*"):
        path = Path(os.path.realpath(entry))
        found.append(Device(entry.name, _text(path / "name"), _text(path / "label"), path.parent.name, path))
    return sorted(found, key=lambda device: _natural(device.number))


def find(wanted: str, root: Path = ROOT) -> Device:
    """The device of that number, name, label or place.

    Raises InputError if several fit, EnvironmentLackError if none does; the text names those that there are.
    """
    present = devices(root)
    number = f"iio:{wanted}" if re.fullmatch(r"device\d+", wanted) else wanted
    exact = [device for device in present if device.number == number]
    fitting = exact or [device for device in present if wanted in (device.name, device.label, device.place)]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise InputError(f"iio {wanted!r}: fits {'; '.join(map(str, fitting))}; name one by its number or its place")
    there = "; ".join(map(str, present)) or "none: `tipforce doctor` says what is missing"
    raise EnvironmentLackError(f"iio {wanted!r}: no such device; there are {there}")


def voltage_channels(path: Path) -> list[str]:
    """Names of the voltage channels, such as ``voltage0``, ``voltage0-voltage1``, or ``voltage`` of an only one."""
    names = (_RAW.fullmatch(entry.name) for entry in path.iterdir())
    return sorted((match[1] for match in names if match), key=_natural)


def raw_value(path: Path, channel: str) -> int:
    """One conversion, in counts. Raises OSError; with EIO for what is no number."""
    return _integer(path / f"in_{channel}_raw")


def attribute(path: Path, channel: str, name: str) -> float | None:
    """``scale`` or ``offset`` of a channel, its own or that of its kind; None if there is none.

    Raises OSError where the kernel has the file and refuses to read it: EINVAL means a reference that is not known.
    """
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
    """How the channel lies in a scan; None where the driver offers no buffer."""
    for folder in ("scan_elements", "buffer0"):
        text = _text(path / folder / f"in_{channel}_type")
        match = _SCAN_TYPE.fullmatch(text)
        if match and match[5] in (None, "1"):
            order, sign, bits, storage, _repeat, shift = match.groups()
            return ScanType(order == "be", sign == "s", int(bits), int(storage), int(shift or 0))
    return None


def temperature_channel(path: Path) -> str | None:
    """The first temperature channel of a device, None if it has none."""
    names = sorted(match[1] for entry in path.iterdir() if (match := _TEMPERATURE.fullmatch(entry.name)))
    return names[0] if names else None


def temperature(path: Path, channel: str) -> int:
    """A temperature in 0.01 degC as 2122h shows it; unknown where INTEGER16 cannot hold it. Raises OSError."""
    try:
        thousandths = float(_integer(path / f"in_{channel}_input"))
    except FileNotFoundError:
        scale, offset = attribute(path, channel, "scale"), attribute(path, channel, "offset")
        thousandths = (raw_value(path, channel) + (offset or 0.0)) * (1.0 if scale is None else scale)
    hundredths = 0.1 * thousandths
    return round(hundredths) if -32767.5 < hundredths < 32767.5 else UNKNOWN_TEMPERATURE


def millivolts(path: Path, channel: str) -> float:
    """The voltage at a channel. Raises OSError; with EINVAL where it has no scale."""
    scale, offset = attribute(path, channel, "scale"), attribute(path, channel, "offset")
    if scale is None:
        raise OSError(22, f"in_{channel}_scale is missing")
    return (raw_value(path, channel) + (offset or 0.0)) * scale


class PolledDevice:
    """Channels of one device, read one after the other whenever asked: a conversion each, waited for."""

    polled = True

    def __init__(self, device: Device, channels: Sequence[str]) -> None:
        self.path = device.path
        self.name = device.number
        self.channels = tuple(channels)
        self._temperature: str | None = None
        self.reopen()

    def reopen(self) -> None:
        """Look for the device anew, at the same place under whatever number. Raises OSError while it is not there."""
        self.path = at_same_place(self.path)
        self._temperature = temperature_channel(self.path)

    def read(self, _now_us: int) -> tuple[int, ...] | None:
        """The counts of all channels. Raises OSError: the device is gone, or does not answer."""
        return tuple([raw_value(self.path, channel) for channel in self.channels])

    def temperature(self) -> int:
        """0.01 degC, or unknown."""
        return temperature_of(self.path, self._temperature)

    def close(self) -> None:
        """Nothing is kept open."""


def at_same_place(path: Path) -> Path:
    """Where a device is now that was at ``path``: a number may change, the place it is plugged in does not.

    Raises OSError while there is none, or several of which none has its old number.
    """
    if path.is_dir():
        return path
    found = sorted(path.parent.glob("iio:device*"))
    if len(found) != 1:
        raise FileNotFoundError(2, "No such device")
    return found[0]


def temperature_of(path: Path, channel: str | None) -> int:
    """``temperature``, and unknown where it cannot be read."""
    try:
        return UNKNOWN_TEMPERATURE if channel is None else temperature(path, channel)
    except OSError:
        return UNKNOWN_TEMPERATURE


def _integer(file: Path) -> int:
    fd = os.open(file, os.O_RDONLY)
    try:
        text = os.read(fd, 64)
    finally:
        os.close(fd)
    try:
        return int(text)
    except ValueError:
        raise OSError(5, f"{file.name} holds no number") from None


def _text(file: Path) -> str:
    """What a file says; empty where it cannot be read."""
    try:
        return file.read_text(errors="replace").strip()
    except OSError:
        return ""


def _natural(name: str) -> list[tuple[int, str]]:
    """A sort key by which device10 comes after device9."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
