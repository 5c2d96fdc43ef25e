"""For all tests: random examples are the same in every run, and no test fails because a machine is slow."""

import os

# The workers of a test run share the cores: threads of the linear algebra library would only wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import shutil
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import settings

settings.register_profile("tipforce", derandomize=True, deadline=None)
settings.load_profile("tipforce")


@pytest.fixture(autouse=True, scope="session")
def no_waiting_for_the_disk() -> Iterator[None]:
    """A node that stores syncs its file: on a disk that others use for seconds, in which no response comes.

    Nodes in processes of their own, which are killed at any instant, do sync."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _descriptor: None)
        yield


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """One Chromium for all tests of a file; a loaded machine has a minute for what they expect."""
    from playwright.sync_api import expect, sync_playwright

    names = ("chromium", "chromium-browser", "google-chrome")
    program = next((path for name in names if (path := shutil.which(name))), "")
    assert program, "these tests need Chromium: tools/bootstrap.sh test installs it"
    expect.set_options(timeout=60_000)
    with (
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=program, args=["--no-sandbox"]) as found,
    ):
        yield found
