"""The files that describe the project agree with each other and have their form; what they refer to exists."""

import re
import shlex
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from docs.runner import check_command

ROOT = Path(__file__).parents[2]
OURS = ROOT / ".github" / "workflows" / "ci.yml"
THEIRS = ROOT / "docs" / "examples" / "vcan-ci.yml"
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def loaded(path: Path) -> Any:
    """The content of a YAML file."""
    yaml = pytest.importorskip("yaml")  # of the extra `docs`
    return yaml.safe_load(path.read_text())


def test_the_citation_is_that_of_the_project() -> None:
    citation = loaded(ROOT / "CITATION.cff")
    assert {"cff-version", "message", "title", "authors", "version", "license"} <= set(citation)
    assert citation["version"] == PYPROJECT["project"]["version"]
    assert citation["license"] == PYPROJECT["project"]["license"]
    assert citation["authors"] == PYPROJECT["project"]["authors"]


def test_issue_forms_are_complete() -> None:
    forms = [form for form in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml") if form.stem != "config"]
    assert len(forms) >= 2
    for content in map(loaded, forms):
        assert {"name", "description", "body"} <= set(content), content
        for field in content["body"]:
            assert {"type", "id", "attributes"} <= set(field)
            assert field["attributes"]["label"]


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


def steps_of(path: Path) -> list[dict[str, Any]]:
    [job] = loaded(path)["jobs"].values()
    return list(job["steps"])


def calls(path: Path, program: str) -> list[list[str]]:
    """The words behind ``program`` wherever a line of a ``run`` calls it, up to what ends a command."""
    lines = [line for step in steps_of(path) for line in step.get("run", "").splitlines()]
    commands = [shlex.split(part) for line in lines for part in re.split(r"&&|\|\||[;|&>]", line)]
    return [words[1:] for words in commands if words[:1] == [program]]


@pytest.mark.parametrize("path", [OURS, THEIRS], ids=lambda path: path.name)
def test_the_form_is_that_of_a_workflow(path: Path) -> None:
    assert "permissions:\n  contents: read\n" in path.read_text()
    for step in steps_of(path):
        assert ("uses" in step) != ("run" in step), step
    used = re.findall(r"uses: (.*)", path.read_text())
    assert all(re.fullmatch(r"actions/[a-z-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", action) for action in used)
    assert [action.split("@")[0] for action in used[:2]] == ["actions/checkout", "actions/setup-python"]


def test_our_own_runs_what_make_has() -> None:
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    called = calls(OURS, "make")
    assert called == [["demo"], ["test"], ["oldest"], ["newest"], ["wheel"]]
    assert all(words[0] in targets for words in called)
    assert re.findall(r'"(3\.\d+)"', OURS.read_text()) == ["3.11", "3.13"]
    assert 'requires-python = ">=3.11"' in (ROOT / "pyproject.toml").read_text()


def test_yours_calls_commands_that_exist() -> None:
    commands = calls(THEIRS, "tipforce")
    assert [words[0] for words in commands] == ["node", "scan", "nmt", "decode"]
    for words in commands:
        check_command(words)
    assert (THEIRS.parent / calls(THEIRS, "python")[-1][-1]).is_file()
    for words in (["frobnicate"], ["nmt", "start", "--nowhere", "5"]):
        with pytest.raises((AssertionError, SystemExit)):
            check_command(words)


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
    except (OSError, subprocess.CalledProcessError):
        return []
    return [name for name in done.stdout.splitlines() if (ROOT / name).exists()]


TRACKED = tracked()
KNOWN = {str(folder) for name in TRACKED for folder in Path(name).parents} | ELSEWHERE
KNOWN |= {"/".join(parts[k:]) for parts in (name.split("/") for name in TRACKED) for k in range(len(parts))}


def exists(mention: str, place: Path) -> bool:
    """Whether a path, the end of a path, or a link relative to ``place`` is a file or folder of the repository."""
    mention = mention.removeprefix("./").rstrip("/")
    return mention in KNOWN or mention.startswith("build/") or (place.parent / mention).exists()


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
        if name not in GENERATED and name != "tests/docs/test_metadata.py"
        for mention in dangling((ROOT / name).read_text(), ROOT / name)
    ]
    assert missing == []


@pytest.mark.skipif(not TRACKED, reason="no git checkout")
def test_a_dangling_reference_is_found() -> None:
    text = "See OBJECTS.md, tests/nowhere, `device/nothing.py`, docs/objects.md, [a](gone.md#b) and core/pdo.py."
    assert list(dangling(text, ROOT / "README.md")) == ["OBJECTS.md", "tests/nowhere", "device/nothing.py", "gone.md"]
