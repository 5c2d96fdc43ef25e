"""The committed files are fresh, the generator writes them, and importing the package costs little."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tipforce.dictionary import generate, table
from tipforce.dictionary.entries import objects
from tipforce.dictionary.generate import reference_markdown
from tipforce.dictionary.signals import tpdo_messages

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "node/tipforce/dictionary"


@pytest.mark.parametrize("name", sorted(generate.generated_files()))
def test_committed_files_are_fresh(name: str) -> None:
    expected = generate.generated_files()[name].encode("ascii")
    assert (ROOT / name).read_bytes() == expected, f"{name} is stale: run `make generate`"


def test_writes_what_differs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert generate.main([str(tmp_path)]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(generate.generated_files())
    assert generate.main([str(tmp_path)]) == 0
    assert capsys.readouterr().out == ""
    assert generate.main(["a", "b"]) == 2
    assert "usage" in capsys.readouterr().err


def test_nothing_heavy_is_imported() -> None:
    modules = [f"tipforce.dictionary.{path.stem}" for path in PACKAGE.glob("*.py") if path.stem != "__init__"]
    code = "import importlib, sys\nfor name in sys.argv[1:]: importlib.import_module(name)\n"
    code += "print([m for m in ('numpy', 'can', 'canopen', 'cantools') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code, *modules], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("n", [3, 8])
def test_reference_names_everything(n: int) -> None:
    text = reference_markdown(n)
    for found in objects(n, True, programs=True):
        assert f"{found.index:04X}h" in text
        for row in found.entries:
            shown = f"`{row.stem}:" if row.is_counted else f"`{row.stem}`"
            assert not row.stem or row.flags & table.VIEW or shown in text, row.name
    for message in tpdo_messages(n):
        assert f"## TPDO{message.number} {message.name.lower()}\n" in text
        assert all(f"`{signal.name}`" in text for signal in message.signals)
    tables = [line for line in text.splitlines() if line.startswith("|")]
    assert all(line.endswith("|") for line in tables)
    assert "\n\n\n" not in text
