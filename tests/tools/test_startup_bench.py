"""bench/startup.py measures the commands as they are."""

from bench import startup


def test_each_figure_is_measured() -> None:
    found = startup.measure(1)
    assert set(found) >= {"python -c pass", "tipforce --help", "tipforce node to boot-up, no bus"}
    assert all(len(runs) == 1 and runs[0] > 0 for runs in found.values())
    assert "tipforce" in dict(startup.imports_ms("-c", startup.NO_BUS_CODE))
