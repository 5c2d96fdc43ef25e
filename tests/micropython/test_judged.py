"""MicroPython judges the recorded data set with every fault as CPython does, in double precision."""

import json

import pytest

from host.decoding.test_judged import recorded
from micropython import engine
from tipforce.dictionary import table_objects

PROGRAM = """
import json
import struct

from tipforce.fingertip.calibration import Active
from tipforce.fingertip.judgement import Judgement


def judge(path):
    with open(path) as file:
        told = json.load(file)
    record = bytes.fromhex(told["record"])
    active = Active(record, list(struct.unpack(told["packing"], record)), told["n"])
    for row, lost, temperature, overloaded in told["samples"]:
        degC = float("nan") if temperature == -0x8000 else 0.01 * temperature
        one = Judgement(active, row, lost, degC, overloaded)
        print(json.dumps([one.bits, one.left_out, one.force, list(one.covariance()) if one.force else None]))
"""


@pytest.mark.parametrize("n", [3, 5, 8])
def test_the_verdicts_of_both_interpreters_are_equal(n: int) -> None:
    calibration, samples = recorded(n)
    overloaded = [False, *(sample.overloaded for sample in samples[:-1])]
    rows, here = [], []
    for sample, before in zip(samples, overloaded, strict=True):
        one = sample.judgement
        assert one is not None
        assert sample.reading is not None
        rows.append([sample.microstrains, one._lost, sample.reading.temperature, before])
        here.append([one.bits, one.left_out, one.force, one.covariance() if one.force else None])
    packing = "<" + "".join(kind for _index, _sub, kind in table_objects.staged(n))
    told = {"record": calibration.record().hex(), "packing": packing, "n": n, "samples": rows}
    files = engine.sources() | {
        f"{engine.LIBRARY}/judging.py": PROGRAM.encode(), "/samples": json.dumps(told).encode(),
    }  # fmt: skip
    calls = ["import sys", f"sys.path.append({engine.LIBRARY!r})", "import judging", "judging.judge('/samples')"]
    there = [json.loads(line) for line in engine.run(files, calls)]
    assert [one[:2] for one in there] == [one[:2] for one in here]
    for mine, theirs in zip(here, there, strict=True):
        for ours, other in zip(mine[2:], theirs[2:], strict=True):
            assert other == (None if ours is None else pytest.approx(ours, rel=1e-12, abs=1e-15))
    assert len(here) > 100
