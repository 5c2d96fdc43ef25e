"""bench/collector.py measures complete rows."""

import pytest
from bench import collector


@pytest.mark.parametrize(("fingers", "frames"), [(5, 1), (15, 16)])
def test_every_row_comes_out(monkeypatch: pytest.MonkeyPatch, fingers: int, frames: int) -> None:
    monkeypatch.setattr(collector, "ROWS", 20)
    assert collector.row_us(fingers, collector.blocks(fingers, frames)) > 0
