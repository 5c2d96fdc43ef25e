"""A node fits a microcontroller. Objects take the same room here as there: pointers of 32 bits, blocks of 16 bytes."""

import pytest

from micropython import engine, footprint

HEAP_BYTES = 180_000  # MicroPython leaves about 200 000 of an ESP32's memory
NODE_BYTES = 46_000
# MicroPython's table of names doubles, some 9 kB, while the modules are imported or while the node is built.
CODE_AND_NODE_BYTES = 164_000


@pytest.fixture(scope="module")
def used() -> footprint.Heap:
    return footprint.heap(engine.compiled(3))


def test_a_node_after_boot(used: footprint.Heap) -> None:
    assert 10_000 < used.node < NODE_BYTES, used


def test_everything_at_the_worst_moment_fits_the_heap(used: footprint.Heap) -> None:
    assert used.code > 10_000
    assert used.code + used.node < CODE_AND_NODE_BYTES, used
    assert used.code + used.node < used.peak < HEAP_BYTES, used


def test_nothing_accumulates(used: footprint.Heap) -> None:
    # What comes once (the EMCY history, a longer list) is in the first thousand steps.
    assert abs(used.after_many - used.after_some) < 500, used
