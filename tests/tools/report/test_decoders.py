"""The study of decoders: the same frames, the same values, and who tells what is unknown."""

from __future__ import annotations

import struct

import pytest

from tipforce.dictionary.signals import tpdo_messages
from tipforce_lab.report.studies import decoders
from tools.report.made import Tiny, at_once


def test_all_decoders_agree_to_rounding_and_one_shows_unknown_values(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decoders, "timed", at_once)
    monkeypatch.setattr(decoders, "BATCHES", (1, 10, 300))
    steps: list[None] = []
    (found,) = decoders.studies(Tiny(), lambda: steps.append(None))
    assert [one.method for one in found.series] == [
        decoders.OURS, decoders.BY_HAND, decoders.CANTOOLS, decoders.CANOPEN,
    ]  # fmt: skip
    assert len(steps) == 6
    # 2^-53 of at most 32767 steps; one more rounding where a decoder multiplies by 0.001.
    for one in found.series:
        assert all(0.0 <= point.error <= 2.0**-52 * 32768 for point in one.points), one.method
    shown = [remark for remark in found.remarks if "decoded as numbers" in remark]
    assert len(shown) == 1
    assert shown[0].startswith(decoders.CANOPEN)


def test_a_wrong_value_is_an_error_of_its_steps() -> None:
    message = next(m for m in tpdo_messages(3) if m.name == "Contact")
    data = [struct.pack("<hhhBB", 1000, decoders.UNKNOWN, -1, 0, 0)]
    error, unknown_shown = decoders.judge([(1.002, None, -0.01)], data, message)
    assert error == pytest.approx(2.0)
    assert unknown_shown == 0
    assert decoders.judge([(1.0, -327.68, -0.01)], data, message)[1] == 1


def test_each_method_gives_every_signal() -> None:
    message = next(m for m in tpdo_messages(3) if m.name == "Contact")
    data = bytes.fromhex("e803102770fe8107")  # P 1.000 N, phi 100.00, theta -4.00 degrees, bits 0 and 7, counter 7
    for method, decode in decoders.others(message).items():
        found = decode(data)
        assert set(found) == {signal.name for signal in message.signals}, method
        assert [found[name] for name in decoders.MEASURED] == pytest.approx([1.0, 100.0, -4.0]), method
        on = {signal.name for signal in message.signals if signal.bits == 1 and found[signal.name]}
        assert (on, found["counter"]) == ({"contact", "fault"}, 7), method
