"""A tree of files as the kernel's Industrial I/O shows it, with devices that may be pulled out and changed."""

import os
import shutil
from pathlib import Path


class Tree:
    """``root`` is the /sys/bus/iio/devices, ``dev`` the /dev of the tests; real directories lie beside them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.root = folder / "bus"
        self.dev = folder / "dev"
        for path in (self.root, self.dev):
            path.mkdir()

    def add(
        self, number: int, place: str, channels: dict[str, int], name: str = "adc", bits: str = "le:u12/16>>0",
        **attributes: str,
    ) -> Path:  # fmt: skip
        """A device ``iio:deviceN`` at ``place``; ``attributes`` such as in_voltage_scale="0.5"."""
        path = self.folder / "devices" / place / f"iio:device{number}"
        path.mkdir(parents=True)
        (path / "name").write_text(name + "\n")
        for channel, counts in channels.items():
            (path / f"in_{channel}_raw").write_text(f"{counts}\n")
        for attribute, text in attributes.items():
            (path / attribute).write_text(text + "\n")
        if bits:
            scan = path / "scan_elements"
            scan.mkdir()
            for index, channel in enumerate(channels):
                (scan / f"in_{channel}_type").write_text(bits + "\n")
                (scan / f"in_{channel}_en").write_text("0\n")
                (scan / f"in_{channel}_index").write_text(f"{index}\n")
        os.symlink(path, self.root / f"iio:device{number}")
        return path

    def add_buffer(self, path: Path, stamped: bool = True) -> Path:
        """Give a device a buffer; a FIFO takes the place of its character device. Returns the FIFO."""
        for name in ("buffer", "trigger"):
            (path / name).mkdir()
        for name, text in (("buffer/enable", "0"), ("buffer/length", "2"), ("trigger/current_trigger", "")):
            (path / name).write_text(text + "\n")
        if stamped:
            (path / "current_timestamp_clock").write_text("realtime\n")
            scan = path / "scan_elements"
            (scan / "in_timestamp_type").write_text("le:s64/64>>0\n")
            (scan / "in_timestamp_en").write_text("0\n")
            (scan / "in_timestamp_index").write_text("15\n")
        fifo = self.dev / path.name
        os.mkfifo(fifo)
        return fifo

    def add_trigger(self, number: int, name: str) -> Path:
        path = self.root / f"trigger{number}"
        path.mkdir()
        (path / "name").write_text(name + "\n")
        (path / "sampling_frequency").write_text("100\n")
        return path

    def remove(self, number: int) -> None:
        link = self.root / f"iio:device{number}"
        shutil.rmtree(link.resolve())
        link.unlink()
