"""MicroPython's compiler takes every file that a node needs."""

from pathlib import Path

import pytest

from micropython import engine

# A node is a server; and what devices from an EDS need, a fingertip does without.
OTHER_DEVICES = {
    "device/sdo_client.py", "device/sdo_client_block.py",
    "device/bit_packing.py", "device/sync_producer.py", "device/wide_types.py",
}  # fmt: skip


@pytest.mark.parametrize("path", engine.on_node_files(), ids=lambda path: path.relative_to(engine.SOURCE).as_posix())
def test_mpy_cross_compiles(path: Path) -> None:
    name = engine.place(path).removesuffix(".py") + ".mpy"
    assert engine.compiled()[name][:1] == b"M"
    assert len(engine.compiled(3)[name]) <= len(engine.compiled(0)[name])


def test_the_whole_device_core_is_among_them_and_nothing_of_a_pc() -> None:
    found = {path.relative_to(engine.SOURCE).as_posix() for path in engine.on_node_files()}
    assert found >= {f"device/{path.name}" for path in engine.SOURCE.glob("device/*.py")} - OTHER_DEVICES
    assert not found & OTHER_DEVICES
    assert found >= {"dictionary/table.py", "sensor/contact/scalar.py", "fingertip/node.py", "sources/simulated.py"}
    assert not found & {"running/loop.py", "running/store.py", "sensor/contact/estimate.py", "errors.py"}
