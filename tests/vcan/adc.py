"""Real kernel ADCs without hardware: the `ti-adc081c` driver on I2C devices whose registers `i2c-stub` keeps.

The registers are set through /dev/i2c-0, as i2c-tools' `i2cset` does, while the kernel's driver reads them."""

import ctypes
import fcntl
import os
import struct
import subprocess
from pathlib import Path

MODULES = (
    "drivers/i2c/i2c-core", "drivers/i2c/i2c-dev", "drivers/i2c/i2c-stub", "drivers/iio/industrialio",
    "drivers/iio/buffer/kfifo_buf", "drivers/iio/buffer/industrialio-triggered-buffer", "drivers/iio/adc/ti-adc081c",
)  # fmt: skip
ADDRESSES = (0x50, 0x51, 0x52)
COUNTS = 4096  # of an adc121c, 12 bits
_BUS = Path("/sys/bus/i2c/devices/i2c-0")
_SLAVE_FORCE, _SMBUS = 0x0706, 0x0720  # linux/i2c-dev.h
_WRITE, _WORD_DATA = 0, 3


def load_modules() -> None:
    """Load the drivers, once. Raises CalledProcessError with the kernel's words."""
    loaded = {line.split()[0] for line in Path("/proc/modules").read_text().splitlines()}
    folder = Path("/usr/lib/uml/modules") / os.uname().release / "kernel"
    for name in MODULES:
        if Path(name).name.replace("-", "_") not in loaded:
            options = [f"chip_addr={','.join(hex(one) for one in ADDRESSES)}"] if name.endswith("i2c-stub") else []
            subprocess.run(["insmod", str(folder / f"{name}.ko"), *options], check=True, capture_output=True)


class Adcs:
    """Three ADCs, each with one channel."""

    def __init__(self) -> None:
        self._bus = os.open("/dev/i2c-0", os.O_RDWR)
        for address in ADDRESSES:
            self.set(address, COUNTS // 2)
            self.plug_in(address)

    def set(self, address: int, counts: int) -> None:
        """What the converter at ``address`` gives from now on, 0 to 4095."""
        # Register 0, a word; the chip sends the high byte first, SMBus the low one.
        word = ctypes.create_string_buffer(struct.pack(">H", counts), 34)
        fcntl.ioctl(self._bus, _SLAVE_FORCE, address)
        fcntl.ioctl(self._bus, _SMBUS, struct.pack("=BBxxIQ", _WRITE, 0, _WORD_DATA, ctypes.addressof(word)))

    def plug_in(self, address: int) -> None:
        (_BUS / "new_device").write_text(f"adc121c {address:#x}")

    def pull_out(self, address: int) -> None:
        (_BUS / "delete_device").write_text(f"{address:#x}")

    def close(self) -> None:
        for address in ADDRESSES:
            if (_BUS.parent / f"0-{address:04x}").exists():
                self.pull_out(address)
        os.close(self._bus)
