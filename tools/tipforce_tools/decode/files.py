"""A directory of output files, written under a temporary name and renamed at the end."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from tipforce.errors import InputError


class NewDirectory:
    """A directory whose files get their names when all are complete."""

    def __init__(self, path: Path, *, force: bool) -> None:
        """Raises InputError for a directory with files, unless ``force``."""
        self.path = path
        if path.exists() and not path.is_dir():
            raise InputError(f"--output {path}/: is an existing file")
        if path.exists() and any(path.iterdir()) and not force:
            raise InputError(f"--output {path}/: is not empty; --force replaces its node=*/part-*.parquet")
        self.partial = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            self.partial.mkdir(parents=True)
        except OSError as error:
            raise InputError(f"--output {path}/: {error.strerror}") from error

    def keep(self) -> None:
        """Move the files into place. Parts of an earlier run are removed; other files stay."""
        self.path.mkdir(parents=True, exist_ok=True)
        for old in self.path.glob("node=*/part-*.parquet"):
            old.unlink()
        for new in sorted(self.partial.iterdir()):
            place = self.path / new.name
            place.mkdir(exist_ok=True)
            for file in sorted(new.iterdir()):
                file.replace(place / file.name)
        for left in self.path.glob("node=*"):
            if left.is_dir() and not any(left.iterdir()):
                left.rmdir()
        shutil.rmtree(self.partial)

    def drop(self) -> None:
        """Remove what was written."""
        shutil.rmtree(self.partial, ignore_errors=True)
