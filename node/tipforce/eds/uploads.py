"""The files that a DCF names for the content of a DOMAIN: UploadFile and DownloadFile (CiA 306-1)."""

from __future__ import annotations

from pathlib import Path

from tipforce.errors import InputError
from tipforce.paths_below import below

_MOST_BYTES = 16 << 20


def file_content(eds: Path, name: str) -> tuple[bytes | None, str]:
    """Return the bytes of the file ``name`` beside ``eds`` and "", or None and why not.

    Only files in the folder of the EDS are read: a device serves their content on the bus to anyone.
    """
    try:
        path = below(eds.resolve().parent, name.replace("\\", "/"))
        if path.stat().st_size > _MOST_BYTES:
            return None, f"larger than {_MOST_BYTES >> 20} MiB; not read"
        return path.read_bytes(), ""
    except (OSError, InputError) as error:
        return None, f"{getattr(error, 'strerror', None) or error}; not read"
