"""No file of the repository refers to a file that is not in it."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXT = {".c", ".cff", ".css", ".h", ".js", ".md", ".py", ".service", ".sh", ".svg", ".toml", ".yml", ".html", ""}
GENERATED = {"docs/objects.md", "LICENSE"}
TOP = r"(?:docs|node|tools|tests|bench|scenes|eds|dbc|\.github)"
# A path from the root; the name of a Python or Markdown file, with as much of its path as is given.
MENTION = re.compile(rf"(?<![\w/.<{{%-])({TOP}/[\w@./-]*\w/?|[\w.][\w./-]*\.(?:py|md))(?![\w{{*-]|\.\w)")
LINK = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)")
# Names that are no file of the repository, and why.
ELSEWHERE = {
    "manifest.py",  # of a MicroPython build
    "press.py",
    "no.py",
    "dimmer.py",  # written, or not, by tests/simulate
    "page.md",  # written by tests/docs/test_examples.py
}


def tracked() -> list[str]:
    """Paths of the files under version control, relative to the root."""
    try:
        done = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, timeout=60, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no git checkout: {error}", allow_module_level=True)
    return [name for name in done.stdout.splitlines() if (ROOT / name).exists()]


TRACKED = tracked()
FOLDERS = {str(folder) for name in TRACKED for folder in Path(name).parents}
ENDS = {"/".join(parts[k:]) for parts in (name.split("/") for name in TRACKED) for k in range(len(parts))}


def exists(mention: str, place: Path) -> bool:
    """Whether a path, the end of a path, or a link relative to ``place`` is a file or folder of the repository."""
    mention = mention.removeprefix("./").rstrip("/")
    return (
        mention.startswith("build/")
        or mention in ENDS
        or mention in FOLDERS
        or mention in ELSEWHERE
        or (place.parent / mention).exists()
    )


def dangling(text: str, place: Path) -> Iterator[str]:
    """The mentions and relative links of a text that lead nowhere."""
    found = [hit[1] for hit in MENTION.finditer(text)]
    if place.suffix == ".md":
        found += [hit[1] for hit in LINK.finditer(text) if not (place.parent / hit[1]).exists()]
    yield from (mention for mention in dict.fromkeys(found) if not exists(mention, place))


@pytest.mark.parametrize("folder", sorted({name.split("/")[0] for name in TRACKED}))
def test_every_file_that_is_mentioned_exists(folder: str) -> None:
    places = [name for name in TRACKED if name.split("/")[0] == folder and Path(name).suffix in TEXT]
    missing = [
        f"{name}: {mention}"
        for name in places
        if name not in GENERATED and name != "tests/docs/test_references.py"
        for mention in dangling((ROOT / name).read_text(), ROOT / name)
    ]
    assert missing == []


def test_a_dangling_reference_is_found() -> None:
    text = "See OBJECTS.md, tests/nowhere, `device/nothing.py`, docs/objects.md, [a](gone.md#b) and core/pdo.py."
    assert list(dangling(text, ROOT / "README.md")) == ["OBJECTS.md", "tests/nowhere", "device/nothing.py", "gone.md"]
