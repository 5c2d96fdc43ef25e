"""The bulk decoder against cantools reading the committed .dbc: every signal of 10 000 random frames."""

import math
from pathlib import Path

import cantools
import numpy as np
import pytest
from cantools.database.can import Database

from tipforce.host.decoding.decoder import Decoder
from tipforce.host.frames.frame_array import FRAME, FrameArray

DBC = Path(__file__).parents[3] / "dbc" / "tipforce.dbc"
FRAMES = 10_000


@pytest.fixture(scope="module")
def database() -> Database:
    loaded = cantools.database.load_file(DBC)
    assert isinstance(loaded, Database)
    return loaded


@pytest.fixture(scope="module")
def frames() -> FrameArray:
    """Random data on all four messages of nodes 1-15, with many values unknown or at a limit."""
    random = np.random.default_rng(20240917)
    made: FrameArray = np.zeros(FRAMES, dtype=FRAME)
    made["t_ns"] = np.arange(FRAMES)
    made["can_id"] = random.choice([0x180, 0x280, 0x380, 0x480], FRAMES) + random.integers(1, 16, FRAMES)
    made["length"] = 8
    words = random.integers(0, 65536, (FRAMES, 4), dtype=np.uint16)
    special = random.choice(np.array([0x8000, 0x8001, 0x7FFF, 0, 0xFFFF], dtype=np.uint16), (FRAMES, 4))
    made["data"] = np.where(random.random((FRAMES, 4)) < 0.2, special, words).astype("<u2").view(np.uint8)
    return made


def test_all_signals_equal_cantools(database: Database, frames: FrameArray) -> None:
    decoded_rows: list[int] = []
    for (node_id, name), samples in Decoder().decode(frames).items():
        message = database.get_message_by_name(f"TIP{node_id:02d}_{name}")
        signals = {signal.name: signal for signal in samples.message.signals}
        decoded_rows += samples.row.tolist()
        for position, row in enumerate(samples.row.tolist()):
            decoded = message.decode(frames["data"][row].tobytes(), decode_choices=True)
            assert isinstance(decoded, dict)
            assert set(decoded) == set(samples.columns)
            for key, theirs in decoded.items():
                ours = samples.columns[key][position]
                if str(theirs) == "unknown":
                    assert math.isnan(ours)
                else:
                    assert isinstance(theirs, int | float)
                    digits = max(-math.floor(math.log10(signals[key].scale)), 0)
                    assert ours == round(float(theirs), digits), (name, key)
    assert sorted(decoded_rows) == list(range(FRAMES))


def test_unknown_occurs_in_each_measurement(frames: FrameArray) -> None:
    unknown = {
        name
        for samples in Decoder().decode(frames).values()
        for name, column in samples.columns.items()
        if column.dtype == np.float64 and np.isnan(column).any()
    }
    assert unknown == {"SG1", "SG2", "SG3", "P", "phi", "theta", "F1", "F2", "F3", "temperature", "u_P"}
