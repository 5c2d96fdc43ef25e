"""The exported C code as libraries that all tests share."""

from collections.abc import Callable
from functools import cache

import pytest

from export_c.estimators import Library


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int, str], Library]:
    """By number of gauges and TIPFORCE_REAL."""
    return cache(lambda n, real: Library(tmp_path_factory.mktemp(f"{real}{n}"), n, real))
