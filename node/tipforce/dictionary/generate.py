"""Write every file that is made from the table: ``python -m tipforce.dictionary.generate [ROOT]``."""

from __future__ import annotations

import sys
from pathlib import Path

from tipforce.dictionary.accessors import accessors_text, indices_text
from tipforce.dictionary.dbc import dbc_text
from tipforce.dictionary.eds import eds_text
from tipforce.dictionary.reference import reference_markdown


def generated_files() -> dict[str, str]:
    """The text of each generated file by its path from the root of the project, with forward slashes."""
    return {
        "eds/tipforce-3.eds": eds_text(3, False),
        "dbc/tipforce.dbc": dbc_text(),
        "docs/objects.md": reference_markdown(3),
        "node/tipforce/dictionary/objects.py": accessors_text(),
        "node/tipforce/dictionary/indices.py": indices_text(),
    }


def write_files(root: Path) -> list[Path]:
    """Write them under ``root`` where they differ, and return those that were written. Raises OSError."""
    written = []
    for name, text in generated_files().items():
        path, data = root / name, text.encode("ascii")
        if not path.is_file() or path.read_bytes() != data:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            written.append(path)
    return written


def main(arguments: list[str]) -> int:
    """Print the files that were written, one a line; 0 done, 2 usage."""
    if len(arguments) > 1 or arguments[:1] in (["-h"], ["--help"]):
        print("usage: python -m tipforce.dictionary.generate [ROOT]", file=sys.stderr)
        return 2
    for path in write_files(Path(*arguments)):
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
