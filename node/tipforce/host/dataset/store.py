"""The files of a dataset in a directory of this machine, or behind any URL that fsspec opens (object store, memory)."""

import atexit
import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from canopen_device.paths_below import below, is_below
from tipforce.errors import EnvironmentLackError, InputError, needing

FOLDER = "_tipforce"
"""Of the manifests, in a dataset."""


def is_url(name: str) -> bool:
    """Return whether a name is a URL."""
    return "://" in name


class Store:
    """Files by their paths relative to ``name``. A file appears complete or not at all."""

    def __init__(self, name: str) -> None:
        """Raises EnvironmentLackError for a URL without its packages, InputError for one of unknown kind."""
        self.name = name.rstrip("/") or "/"
        self.filesystem: Any = None
        """The fsspec file system; None for a directory of this machine."""
        local = self.name.removeprefix("file://").removeprefix("local://")
        self._root = os.path.realpath(local)
        if is_url(local):
            self.filesystem, self._root = filesystem(self.name)

    @property
    def local(self) -> Path | None:
        """The directory; None behind a URL."""
        return Path(self._root) if self.filesystem is None else None

    def path(self, relative: str) -> str:
        """Return the path for ``filesystem``. Raises InputError where it leaves the dataset, and for a link."""
        if self.filesystem is None:
            return str(below(self._root, relative, f"{self.name}: path", links=False))
        if not is_below(relative):
            raise InputError(f"{self.name}: path = {relative!r}: allowed is one below it")
        return f"{self._root}/{relative}"

    def names(self, folder: str) -> list[str]:
        """Return the names in a folder, "" for the dataset itself; none if it does not exist."""
        place = self.path(folder) if folder else self._root
        with suppress(FileNotFoundError, NotADirectoryError):
            if self.filesystem is None:
                return os.listdir(place)
            self.filesystem.invalidate_cache()
            return [str(path).rsplit("/", 1)[-1] for path in self.filesystem.ls(place, detail=False)]
        return []

    def open(self, relative: str) -> BinaryIO:
        """Open a file. Raises FileNotFoundError, OSError."""
        if self.filesystem is None:
            return Path(self.path(relative)).open("rb")
        opened: BinaryIO = self.filesystem.open(self.path(relative), "rb")
        return opened

    def create(self, relative: str, content: bytes) -> bool:
        """Create a file; return False, without a change, if there is one. Raises OSError."""
        place = self.path(relative)
        if self.filesystem is not None:
            if self.filesystem.exists(place):
                return False
            try:
                with self.filesystem.open(place, "xb") as file:
                    file.write(content)
            except FileExistsError:
                return False
            except (ValueError, NotImplementedError):  # a file system without exclusive creation
                self.filesystem.pipe_file(place, content)
            return True
        import uuid  # here and below: a log is read without these

        path = Path(place)
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
        try:
            partial.write_bytes(content)
            os.link(partial, path)  # unlike a rename it fails if there is a file
        except FileExistsError:
            return False
        except OSError as error:
            if error.errno not in (errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK) or path.exists():
                raise
            partial.rename(path)  # without hard links (FAT): two writers must not commit at the same instant
        finally:
            partial.unlink(missing_ok=True)
        return True

    @contextmanager
    def scratch(self, relative: str) -> Iterator[Path]:
        """Give a folder for files before ``put``: this one in a directory, which stays; else a temporary one."""
        if self.filesystem is None:
            folder = Path(self.path(relative))
            folder.mkdir(parents=True, exist_ok=True)
            yield folder
            return
        import tempfile

        with tempfile.TemporaryDirectory(prefix="tipforce-") as name:
            yield Path(name)

    def put(self, file: Path, relative: str) -> None:
        """Move a complete local file here. Raises OSError."""
        if self.filesystem is None:
            path = Path(self.path(relative))
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                file.replace(path)
            except OSError:  # of another file system
                import shutil

                partial = path.with_name(f".{path.name}.part")
                shutil.copyfile(file, partial)
                partial.replace(path)
            return
        self.filesystem.makedirs(self.path(relative).rsplit("/", 1)[0], exist_ok=True)
        self.filesystem.put_file(str(file), self.path(relative))
        file.unlink()

    def remove(self, relative: str) -> None:
        """Remove a file if it is there."""
        with suppress(FileNotFoundError):
            if self.filesystem is None:
                os.unlink(self.path(relative))
            else:
                self.filesystem.rm_file(self.path(relative))


def generations(store: Store) -> list[str]:
    """Return the names of the manifests, the newest last."""
    return sorted(name for name in store.names(FOLDER) if re.fullmatch(r"manifest-\d{10}\.json", name))


def is_dataset(name: str | os.PathLike[str]) -> bool:
    """Return whether a path or URL is a dataset."""
    text = str(name)
    may_be = text.endswith("/") if is_url(text) else (Path(text) / FOLDER).is_dir()
    return may_be and bool(generations(Store(text)))


_copies: dict[str, str] = {}


def local_copy(name: str) -> str:
    """Return the path of a log; of a URL that of a copy, which this process makes once and removes at its end. Raises
    InputError for one that cannot be read, EnvironmentLackError as ``Store``."""
    if not is_url(name) or name.startswith("file://"):
        return name.removeprefix("file://")
    if name not in _copies:
        import shutil
        import tempfile

        files, path = filesystem(name)
        folder = tempfile.mkdtemp(prefix="tipforce-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        copy = os.path.join(folder, path.rsplit("/", 1)[-1])
        try:
            files.get_file(path, copy)
        except Exception as error:  # each file system raises its own
            text = str(error) or type(error).__name__
            raise InputError(f"{name}: can't be read: {text}; a dataset's URL ends in /") from error
        _copies[name] = copy
    return _copies[name]


def url_of(path: str) -> str:
    """Return the URL of a local copy; another path as it is."""
    return next((url for url, copy in _copies.items() if copy == path), path)


def filesystem(url: str) -> tuple[Any, str]:
    """Return fsspec's file system of a URL, and the path in it. Raises as ``Store`` does."""
    with needing(f"{url}: a URL needs fsspec: `pip install 'tipforce[remote]'`"):
        import fsspec.core
    try:
        files, path = fsspec.core.url_to_fs(url)
    except ImportError as error:
        raise EnvironmentLackError(f"{url}: {error}: install them with pip") from error
    except ValueError as error:
        raise InputError(f"{url}: not a URL that fsspec opens: {error}") from error
    return files, str(path).rstrip("/")
