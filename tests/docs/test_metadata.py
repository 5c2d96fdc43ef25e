"""The files that describe the project agree with each other and have their form."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_the_citation_is_that_of_the_project() -> None:
    yaml = pytest.importorskip("yaml")  # of the extra `docs`
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors", "version", "license"} <= set(citation)
    assert citation["version"] == PYPROJECT["project"]["version"]
    assert citation["license"] == PYPROJECT["project"]["license"]
    assert citation["authors"] == PYPROJECT["project"]["authors"]


def test_issue_forms_are_complete() -> None:
    yaml = pytest.importorskip("yaml")
    forms = sorted(
        set((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")) - {ROOT / ".github/ISSUE_TEMPLATE/config.yml"}
    )
    assert len(forms) >= 2
    for form in forms:
        content = yaml.safe_load(form.read_text())
        assert {"name", "description", "body"} <= set(content), form
        assert all(
            {"type", "id", "attributes"} <= set(field) and field["attributes"]["label"] for field in content["body"]
        )


def test_the_changelog_has_an_unreleased_part_on_top_and_known_sections() -> None:
    headings = re.findall(r"^(#{2,3}) (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    versions = [name for level, name in headings if level == "##"]
    assert versions[0] == "Unreleased"
    assert {name for level, name in headings if level == "###"} <= {"Added", "Changed", "Fixed", "Removed"}


def test_the_architecture_names_every_layer() -> None:
    [layers] = [c["layers"] for c in PYPROJECT["tool"]["importlinter"]["contracts"] if c["type"] == "layers"]
    page = (ROOT / "docs" / "architecture.md").read_text()
    drawing = (ROOT / "docs" / "figures" / "layers.svg").read_text()
    for name in (name.strip() for layer in layers for name in re.split(r"[|:]", layer)):
        assert f"`{name}`" in page
        assert f">{name.removeprefix('tipforce.')}</text>" in drawing


def test_no_folder_of_tests_is_left_out() -> None:
    """`make test` runs the paths that pytest is given here, and tests/vcan on its own."""
    listed = PYPROJECT["tool"]["pytest"]["ini_options"]["testpaths"]
    folders = {f"tests/{path.parent.name}" for path in (ROOT / "tests").glob("*/test_*.py")}
    folders |= {f"tests/{path.parts[-3]}" for path in (ROOT / "tests").glob("*/*/test_*.py")}
    assert set(listed) == folders - {"tests/vcan"}


def test_the_readme_names_every_system_package() -> None:
    script = (ROOT / "tools" / "bootstrap.sh").read_text()
    lists = re.findall(r"missing\+=\(([^)]*)\)|apt_install ([a-z0-9][\w -]*)", script)
    packages = {name for pair in lists for name in " ".join(pair).split()}
    assert {"can-utils", "chromium", "python3-venv"} <= packages
    readme = (ROOT / "README.md").read_text()
    assert [name for name in sorted(packages) if f"`{name}`" not in readme] == []
