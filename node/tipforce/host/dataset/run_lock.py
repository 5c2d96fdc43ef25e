"""A mark that a run is writing to a dataset; what a run that was killed has left behind is removed by the next one."""

from __future__ import annotations

import os
import re
import shutil
from contextlib import suppress
from pathlib import Path

from tipforce.host.dataset.manifest import EVENTS, ROWS, Manifest, read_manifest
from tipforce.host.dataset.store import FOLDER, Store


class RunLock:
    """Held while a run writes to a dataset in a directory of this machine. The system releases it with the process."""

    def __init__(self, store: Store, token: str) -> None:
        self._store, self._token = store, token
        self._file: int | None = None

    def __enter__(self) -> RunLock:
        if self._store.local is not None:
            folder = Path(self._store.path(FOLDER))
            folder.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self._store.path(f"{FOLDER}/{self._token}.run"), os.O_CREAT | os.O_RDWR)
            lock(self._file)
            for mark in folder.glob("*.run"):
                if mark.stem != self._token and re.fullmatch(r"[0-9a-f]{12}\.run", mark.name) and not mark.is_symlink():
                    _clean(self._store, mark)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._file is not None and self._store.local is not None:
            folder = self._store.local / FOLDER
            if kind is not None:
                remove_unlisted(self._store, read_manifest(self._store) or Manifest(), self._token)
            shutil.rmtree(folder / self._token, ignore_errors=True)
            (folder / f"{self._token}.run").unlink(missing_ok=True)
            os.close(self._file)


def _clean(store: Store, mark: Path) -> None:
    """Remove what a run has left, unless it is still running."""
    with suppress(OSError):
        file = os.open(mark, os.O_RDWR)
        try:
            if not lock(file):
                return
            remove_unlisted(store, read_manifest(store) or Manifest(), mark.stem)
            shutil.rmtree(mark.with_suffix(""), ignore_errors=True)
            mark.unlink(missing_ok=True)
        finally:
            os.close(file)


def lock(file: int) -> bool:
    """Lock an open file for this process and those that it starts; False if another one has it."""
    try:
        import fcntl
    except ImportError:  # Windows: marks of other runs are left alone
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def remove_unlisted(store: Store, manifest: Manifest, token: str) -> None:
    """Remove the files of a run that no manifest lists."""
    assert store.local is not None
    listed = manifest.paths()
    for pattern in (f"{ROWS}/hand=*/date=*/node=*/*-{token}.parquet", f"{EVENTS}/*-{token}.parquet"):
        for path in store.local.glob(pattern):
            relative = path.relative_to(store.local).as_posix()
            if relative not in listed:
                store.remove(relative)
