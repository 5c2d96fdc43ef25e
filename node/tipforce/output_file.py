"""Output files: written under a temporary name beside their own, and renamed when complete: an error leaves the old
file. A file that is also an input, or of another kind than the new one, is refused."""

import io
import os
import re
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from tipforce.errors import InputError, WriteError

_HEAD_BYTES = 4096


class Kind(NamedTuple):
    """A kind of file: its name in messages, with the article, and a pattern that its first bytes contain."""

    name: str
    pattern: bytes


CALIBRATION = Kind("a calibration file", rb"(?m)^\[calibration\]")
LAYOUT = Kind("a layout file", rb"(?m)^points\s*=")
SETTINGS = Kind("a settings file", rb"(?m)^\[objects\]")
EDS = Kind("an EDS or DCF", rb"(?mi)^\[(FileInfo|DeviceInfo|DeviceComissioning)\]")
BUS_CONFIGURATION = Kind("a bus.yml of ros2_canopen", rb"(?m)^ *dcf_path:")
XDD = Kind("an XDD", rb"ISO15745ProfileContainer")
MJCF = Kind("an MJCF model", rb"<mujoco")
DBC = Kind("a DBC", rb"(?m)^(VERSION|BO_|NS_)")
CSV = Kind("a CSV file", rb"\A[^\n\0=\[{]*,")
JSON_LINES = Kind("a JSON lines file", rb"\A\s*\{")
CONTACT_TEXT = Kind("a text of `tipforce decode`", rb"\A(\([ \d.]+\)  )?.*node +\d")
CANDUMP_LOG = Kind("a candump log", rb"\A\s*\(\d+\.\d+\) ")
PARQUET = Kind("a Parquet file", rb"\APAR1")
MCAP = Kind("an MCAP file", rb"\A\x89MCAP")
C_SOURCE = Kind("a C source", rb"\A\s*(/\*|//|#)")
HTML = Kind("an HTML page", rb"(?i)\A\s*<!doctype html")
FIGURES = {
    ".svg": Kind("an SVG file", rb"<svg|\A\s*<\?xml"),
    ".png": Kind("a PNG file", rb"\A\x89PNG"),
    ".pdf": Kind("a PDF file", rb"\A%PDF"),
}


def check_output(path: str | Path, kind: Kind | None = None, inputs: Iterable[str | Path] = ()) -> None:
    """Check an output before the work. Raises InputError for a directory, an input, or a file of another kind."""
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a directory; name a file")
    for given in inputs:
        with suppress(OSError):
            if os.path.samefile(path, given):
                raise InputError(f"{path}: is also an input; choose another name")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the directory {path.parent} does not exist; create it first")
    if kind is None or not path.is_file():
        return
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    if head and not re.search(kind.pattern, head):
        raise InputError(f"{path}: the existing file is not {kind.name}; choose another name, or remove it")


def make_folder(path: Path) -> None:
    """Create an output folder and its parents if they are missing. Raises InputError."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise InputError(f"--output {path}: is a file; name a directory") from None
    except OSError as error:
        raise InputError(f"--output {path}: {error.strerror}") from error


class NewFile:
    """A file that gets its name when it is complete. Devices and pipes are written directly."""

    def __init__(self, path: str | Path, kind: Kind | None = None, inputs: Iterable[str | Path] = ()) -> None:
        """Raises InputError for a path that cannot be written, and as check_output does."""
        check_output(path, kind, inputs)
        self.path = Path(path)
        self._direct = self.path.exists() and (not self.path.is_file() or str(path).startswith("/dev/"))
        self._target = self.path.resolve()  # a symbolic link stays one
        self.partial = self.path if self._direct else self._target.with_name(f".{self.path.name}.{os.getpid()}.part")
        try:
            if self._target.exists() and not os.access(self._target, os.W_OK):
                raise PermissionError(0, "Permission denied")
            if not self._direct:
                self.partial.unlink(missing_ok=True)
            self.partial.open("ab" if self._direct else "xb").close()  # new: a link of that name is not followed
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}") from error

    def keep(self) -> None:
        """Rename the complete file; an existing file is replaced, and its permissions hold."""
        if not self._direct:
            if self._target.exists():
                self.partial.chmod(stat.S_IMODE(self._target.stat().st_mode))
            self.partial.replace(self._target)

    def drop(self) -> None:
        """Remove the incomplete file."""
        if not self._direct:
            self.partial.unlink(missing_ok=True)

    def failed(self, error: OSError) -> WriteError:
        """Return the error to raise for a failed write, for example on a full disk."""
        old = "the old file is unchanged" if not self._direct and self._target.exists() else "no file was written"
        return WriteError(f"{self.path}: {error.strerror or error}; {old}")


@contextmanager
def new_file(path: str | Path, kind: Kind | None = None, inputs: Iterable[str | Path] = ()) -> Iterator[Path]:
    """Give the path to write to; at the end of the block the file gets its name, unless an error occurred. Raises
    InputError for a path that cannot be written and as check_output does, WriteError for a failed write."""
    file = NewFile(path, kind, inputs)
    try:
        yield file.partial
        file.keep()
    except OSError as error:
        file.drop()
        raise file.failed(error) from error
    except BaseException:
        file.drop()
        raise


def write_file(path: str | Path, content: str | bytes, kind: Kind | None = None) -> None:
    """Write a whole file, text as UTF-8. Raises as new_file does."""
    with new_file(path, kind) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)


def write_files(folder: Path, files: Mapping[str, tuple[str, Kind]]) -> list[Path]:
    """Write texts by their names into a folder, created if it is missing; return the paths. Raises as make_folder and
    new_file do; a file of another kind is refused before the first is written."""
    make_folder(folder)
    for name, (_, kind) in files.items():
        check_output(folder / name, kind)
    for name, (text, kind) in files.items():
        write_file(folder / name, text, kind)
    return [folder / name for name in files]


def figure_kind(path: str | Path, allowed: Iterable[str] = (".svg", ".png")) -> Kind:
    """Return the kind of a figure by its suffix. Raises InputError for another one."""
    suffix = Path(path).suffix.lower()
    if suffix not in allowed:
        raise InputError(f"figure {path}: allowed are the suffixes {', '.join(allowed)}")
    return FIGURES[suffix]


def save_figure(figure: Any, path: str | Path, allowed: Iterable[str] = (".svg", ".png"), **options: Any) -> None:
    """Write a figure of matplotlib without a date, so that equal data give equal files. Raises InputError for another
    suffix than ``allowed``, and as new_file does."""
    from matplotlib import rc_context

    kind = figure_kind(path, allowed)
    suffix = Path(path).suffix.lower()
    metadata = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}, ".png": {"Software": None}}[suffix]
    drawn = io.BytesIO()  # matplotlib leaves a file open if writing fails
    with rc_context({"svg.hashsalt": "tipforce"}):  # otherwise the names in an SVG are random
        figure.savefig(drawn, format=suffix[1:], metadata=metadata, **options)
    write_file(path, drawn.getvalue(), kind)
