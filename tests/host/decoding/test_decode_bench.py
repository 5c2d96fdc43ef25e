"""What the benchmark of decoding measures with: its logs, its floor in C, its comparison with cantools."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from bench.decode import FLOOR, different_values, hand_traffic, random_frames, write_log
from bench.decode_methods import cantools_loop, memory, memory_sum

from tipforce.host.decoding.decoder import Decoder
from tipforce.host.logs.reader import open_log


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "hand.log"
    traffic = hand_traffic(20_000, 3, 5)
    write_log(path, traffic)
    np.testing.assert_array_equal(np.concatenate(list(open_log(path, strict=True))), traffic)
    assert set(traffic["length"].tolist()) == set(range(9))
    return path


@pytest.mark.skipif(not shutil.which("gcc"), reason="needs a C compiler")
def test_the_floor_in_c_finds_the_same(log: Path, tmp_path: Path) -> None:
    floor = tmp_path / "floor"
    subprocess.run(["gcc", "-O2", "-Wall", "-Wextra", "-Werror", "-o", floor, FLOOR], check=True)
    frames, decoded, bad, total, _ = subprocess.run([floor, log], check=True, capture_output=True).stdout.split()
    found = memory(log)
    assert (int(frames), int(decoded), int(bad)) == (20_000, found["decoded"], 0)
    np.testing.assert_allclose(float(total), memory_sum(log), rtol=1e-9)


def test_cantools_finds_the_same(log: Path) -> None:
    found = cantools_loop(log)
    assert found["decoded"] == memory(log)["decoded"]
    np.testing.assert_allclose(found["sum"], memory_sum(log), rtol=1e-9)


def test_every_value_is_that_of_cantools() -> None:
    """`python -m bench.decode --check` compares those of a million frames."""
    unknown, columns = set[str](), 0
    for samples in Decoder().decode(random_frames(10_000, 20240917)).values():
        unknown |= {
            name for name, column in samples.columns.items() if column.dtype == float and np.isnan(column).any()
        }
        columns += len(samples.columns) * len(samples.row)
    assert unknown == {"SG1", "SG2", "SG3", "P", "phi", "theta", "F1", "F2", "F3", "temperature", "u_P"}
    assert different_values(10_000) == (columns, 0)
