"""Every documented example executes: the docs say what the code does."""

import doctest
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
MUST_HAVE_EXAMPLES = {
    "calibration.md",
    "decode.md",
    "finite-elements.md",
    "hand.md",
    "hardware.md",
    "mechanics.md",
    "protocol.md",
    "recipes.md",
    "scenes.md",
    "tools.md",
}


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_documented_examples_run(path: Path) -> None:
    result = doctest.testfile(
        str(path), module_relative=False, optionflags=doctest.NORMALIZE_WHITESPACE, report=True, encoding="utf-8"
    )
    assert result.failed == 0
    if path.name in MUST_HAVE_EXAMPLES:
        assert result.attempted > 0


def test_documents_are_found() -> None:
    assert {path.name for path in DOCUMENTS} >= {"README.md", "protocol.md", "objects.md"}
