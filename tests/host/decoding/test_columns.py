"""The compiled core and numpy extract equal values, bit by bit, for any layout."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.core import core
from tipforce.dictionary.signals import Signal
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.decoding.sample_table import SIGNAL, Layout, columns_of
from tipforce.host.frames.frame_array import FRAME

pytestmark = pytest.mark.skipif(core is None, reason="needs the compiled core")
SCALES = st.sampled_from([1.0, 0.001, 0.01, 0.1, 0.25, 3.0, 0.0375, -2.0, 0.0])
SPECIAL = (0, 1, 0x8000, 0x8000_8000_8000_8000, (1 << 64) - 1, 0x7FFF, 0x7FA0_0000, 0xFFF4_0000_0000_0000)


@st.composite
def signals(draw: st.DrawFn, name: str) -> Signal:
    real = draw(st.booleans())
    bits = draw(st.sampled_from([32, 64]) if real else st.sampled_from([1, 1, 2, 7, 8, 12, 16, 24, 32, 40, 64]))
    start = draw(st.integers(0, 64 - bits))
    unknown = None if real else draw(st.none() | st.integers(0, (1 << bits - 1) - 1))
    scale, offset = draw(SCALES), draw(st.sampled_from([0.0, -40.0, 0.1]))
    signed, big_endian = draw(st.booleans()), draw(st.booleans())
    return Signal(name, start, bits, signed, scale, "", 0, 0, unknown, "", 0, 0, real, offset, big_endian)


LAYOUTS = st.integers(1, 12).flatmap(lambda count: st.tuples(*(signals(f"s{k}") for k in range(count))))


@settings(max_examples=150)
@given(LAYOUTS, st.integers(0, 1 << 32), st.integers(0, 100))
def test_both_bodies_give_equal_bits(layout: tuple[Signal, ...], seed: int, count: int) -> None:
    words = np.random.default_rng(seed).integers(0, 1 << 64, count, dtype=np.uint64)
    words[: len(SPECIAL)] = SPECIAL[:count]
    row = np.random.default_rng(seed).permutation(count)
    in_rows, wide = Layout(layout).columns(words, row), Layout(layout, wide=True).columns(words)
    by_core, by_numpy = Layout(layout).columns(words), columns_of(words, layout)
    assert list(by_core) == list(by_numpy)
    for name, column in by_numpy.items():
        assert by_core[name].dtype == column.dtype
        assert in_rows[name][row].tobytes() == by_core[name].tobytes()
        assert np.array_equal(wide[name], by_core[name], equal_nan=column.dtype.kind == "f")
        known = ~np.isnan(column)  # a NaN is a NaN, whatever its other bits
        assert (known == ~np.isnan(by_core[name])).all(), name
        assert by_core[name][known].tobytes() == column[known].tobytes(), name


def test_the_order_of_messages_and_signals_is_that_of_the_layout() -> None:
    frames = np.zeros(8, dtype=FRAME)
    frames["can_id"], frames["length"] = np.resize([0x283, 0x481, 0x281, 0x183], 8), 8
    found = Decoder(node_ids=range(1, 6)).decode(frames)
    assert list(found) == [(3, "Gauges"), (1, "Contact"), (3, "Contact"), (1, "Health")]
    assert list(found[1, "Contact"].columns)[:3] == ["P", "phi", "theta"]


def test_the_core_refuses_what_does_not_fit() -> None:
    """Columns that are longer or shorter than the memory for them, and signals beyond the eighth byte."""
    words, out = np.zeros(3, dtype=np.uint64), np.zeros(24, dtype=np.uint8)
    row = np.zeros(1, dtype=SIGNAL)
    row["bits"], row["size"], row["kind"] = 64, 8, 1
    in_order = np.zeros(0, dtype=np.int64)
    core.extract(words, row, out, in_order)
    for places in ([0, 1], [0, 1, 3], [0, -1, 2]):
        with pytest.raises(ValueError, match="extract"):
            core.extract(words, row, out, np.array(places))
    for changed, memory in (({}, out[:-1]), ({}, np.zeros(25, dtype=np.uint8)), ({"start": 1}, out), ({"size": 3}, out),
                            ({"bits": 0}, out), ({"size": 4, "kind": 2}, out[:12])):  # fmt: skip
        bad = row.copy()
        for name, value in changed.items():
            bad[name] = value
        with pytest.raises(ValueError, match="extract"):
            core.extract(words, bad, memory, in_order)


def test_a_wide_column_of_64_bits_without_sign_stays_unsigned() -> None:
    layout = Layout((Signal("s", 0, 64, False, 1.0, "", 0, 0, None, "", 0, 0),), wide=True)
    assert layout.columns(np.array([(1 << 64) - 1], dtype=np.uint64))["s"].tolist() == [(1 << 64) - 1]
