"""Few frames are decoded one after another, many in columns: the values are equal bit by bit, for any layout."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.dictionary.signals import Message, Signal
from tipforce.host.decoding.decoder import FEW, Decoder
from tipforce.host.frames.frame_array import FRAME, FrameArray

FRAMES = 3 * FEW
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


@st.composite
def decoders(draw: st.DrawFn) -> Decoder:
    messages = {}
    for number in range(draw(st.integers(1, 3))):
        found = tuple(draw(signals(f"s{k}")) for k in range(draw(st.integers(1, 12))))
        length = draw(st.integers(1, 8))
        message = Message("tpdo", 0, f"m{number}", 0, length, found, (), True, 255, 0)
        for node in range(1, 1 + draw(st.integers(1, 3))):
            messages[node, message.name] = 0x100 + 16 * number + node, message
    return Decoder.of_messages(messages)


def frames(seed: int) -> FrameArray:
    rng = np.random.default_rng(seed)
    found = np.zeros(FRAMES, dtype=FRAME)
    found["t_ns"] = rng.integers(0, 1 << 62, FRAMES)
    found["can_id"] = 0x100 + 16 * rng.integers(0, 4, FRAMES) + rng.integers(0, 5, FRAMES)
    found["length"] = rng.integers(4, 9, FRAMES)
    words = rng.integers(0, 1 << 64, FRAMES, dtype=np.uint64)
    words[: len(SPECIAL)] = SPECIAL
    found["data"] = words.view(np.uint8).reshape(FRAMES, 8)
    return found


@settings(max_examples=60)
@given(decoders(), st.integers(0, 1 << 32), st.integers(1, FEW))
def test_few_frames_and_many_give_equal_bits(decoder: Decoder, seed: int, batch: int) -> None:
    given_frames = frames(seed)
    together = decoder.decode(given_frames)
    malformed, decoder.malformed = decoder.malformed, {}
    found = [(at, decoder.decode(given_frames[at : at + batch])) for at in range(0, FRAMES, batch)]
    assert decoder.malformed == malformed
    assert {key for _, part in found for key in part} == set(together)
    for key, samples in together.items():
        parts = [(at, part[key]) for at, part in found if key in part]
        assert np.concatenate([one.row + at for at, one in parts]).tolist() == samples.row.tolist()
        assert np.concatenate([one.t_ns for _, one in parts]).tolist() == samples.t_ns.tolist()
        for name, column in samples.columns.items():
            other = np.concatenate([one.columns[name] for _, one in parts])
            assert other.dtype == column.dtype
            known = ~np.isnan(column)  # a NaN is a NaN, whatever its other bits
            assert (known == ~np.isnan(other)).all(), name
            assert other[known].tobytes() == column[known].tobytes(), name


def test_the_order_of_messages_and_signals_is_that_of_the_layout() -> None:
    decoder = Decoder(node_ids=range(1, 6))
    given_frames = frames(5)
    given_frames["can_id"] = np.resize([0x283, 0x481, 0x281, 0x183], FRAMES)
    given_frames["length"] = 8
    few, many = decoder.decode(given_frames[:8]), decoder.decode(given_frames)
    assert list(few) == list(many)
    assert [list(one.columns) for one in few.values()] == [list(one.columns) for one in many.values()]
