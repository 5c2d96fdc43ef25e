"""For all tests: random examples are the same in every run, and no test fails because a machine is slow."""

import os

# The workers of a test run share the cores: threads of the linear algebra library would only wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Iterator

import pytest
from hypothesis import settings

settings.register_profile("tipforce", derandomize=True, deadline=None)
settings.load_profile("tipforce")


@pytest.fixture(autouse=True, scope="session")
def no_waiting_for_the_disk() -> Iterator[None]:
    """A node that stores syncs its file: on a disk that others use for seconds, in which no response comes.

    Nodes in processes of their own, which are killed at any instant, do sync.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _descriptor: None)
        yield
