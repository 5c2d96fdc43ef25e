"""The documentation site builds without a warning, and its pages load nothing from the network."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

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
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr  # with --quiet a warning would be no failure
    return folder


def test_every_document_is_a_page(site: Path) -> None:
    documents = {path.relative_to(ROOT / "docs").with_suffix(".html") for path in (ROOT / "docs").rglob("*.md")}
    pages = {path.relative_to(site) for path in site.rglob("*.html")}
    assert documents == pages - {Path("404.html")}


def test_pages_load_nothing_from_the_network(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 25
    loaded = [f"{page.relative_to(site)}: {hit[0]}" for page in pages for hit in LOADED.finditer(page.read_text())]
    assert loaded == []
    assert not any('class="mermaid"' in page.read_text() for page in pages)  # the theme would fetch mermaid.js
    for style in site.rglob("*.css"):
        assert not re.search(r"@import|url\([\"']?https?:", style.read_text()), style


def test_the_reference_shows_the_public_packages(site: Path) -> None:
    for name, packages in {
        "tipforce": ("tipforce", "tipforce.host", "tipforce.sensor", "tipforce.fingertip"),
        "canopen_device": ("canopen_device", "canopen_device.eds"),
        "robots": ("tipforce_robots.mujoco",),
    }.items():
        text = (site / "reference" / f"{name}.html").read_text()
        assert "doc-module" in text
        assert "Source code in" not in text
        for package in packages:
            assert f'<h1 id="{re.sub("[._]", "", package)}"' in text or f'<h1 id="{package.replace(".", "")}"' in text


def test_the_search_works_from_the_disk(site: Path, browser: Browser) -> None:
    page = browser.new_page()
    wrong: list[str] = []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.goto(f"{(site / 'index.html').as_uri()}")
    page.locator("label.md-search__icon[for=__search]").first.click(force=True)
    page.locator("input.md-search__input").press_sequentially("theta_unresolved")
    expect(page.locator(".md-search-result__item").first).to_contain_text("theta_unresolved", timeout=60_000)
    assert wrong == []
    page.close()


def test_no_page_is_wider_than_a_phone(site: Path, browser: Browser) -> None:
    page = browser.new_page(viewport={"width": 390, "height": 844})
    wide = []
    for path in sorted(site.rglob("*.html")):
        page.goto(path.as_uri())
        width = page.evaluate("document.documentElement.scrollWidth")
        if width > 390:
            wide.append(f"{path.relative_to(site)}: {width}")
    page.close()
    assert wide == []
