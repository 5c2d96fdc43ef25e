"""The documentation site builds without a warning, and its pages load nothing from the network."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LOADED = re.compile(
    r"""<(?:script|img|iframe|source)[^>]*\bsrc="?https?:"""
    r"""|<link[^>]*rel="?(?:stylesheet|preconnect)"?[^>]*href="?https?:"""
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site; a warning is a failure."""
    for package in ("mkdocs", "material", "mkdocstrings_handlers"):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f'{package} is not installed: pip install "tipforce[docs]"')
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)],
        cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True, text=True, timeout=150, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
    return folder


def test_every_document_is_a_page(site: Path) -> None:
    documents = {path.relative_to(ROOT / "docs").with_suffix(".html") for path in (ROOT / "docs").rglob("*.md")}
    pages = {path.relative_to(site) for path in site.rglob("*.html")}
    assert documents == pages - {Path("404.html")}


def test_pages_load_nothing_from_the_network(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 30
    loaded = [f"{page.relative_to(site)}: {hit[0]}" for page in pages for hit in LOADED.finditer(page.read_text())]
    assert loaded == []
    assert not any('class="mermaid"' in page.read_text() for page in pages)  # the theme would fetch mermaid.js
    for style in site.rglob("*.css"):
        assert not re.search(r"@import|url\([\"']?https?:", style.read_text()), style


def test_the_reference_shows_the_public_packages(site: Path) -> None:
    for page, package in (("tipforce", "tipforce"), *((n, f"tipforce.{n}") for n in ("device", "host", "sensor"))):
        text = (site / "reference" / f"{page}.html").read_text()
        assert f'id="{package}"' in text
        assert "Source code in" not in text


def test_the_search_finds_terms_of_the_pages(site: Path) -> None:
    index = (site / "search" / "search_index.js").read_text()
    for term in ("heartbeat_lost", "theta_unresolved", "condition number"):
        assert term in index
