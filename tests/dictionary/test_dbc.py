"""The .dbc as cantools reads it."""

from __future__ import annotations

import struct
from functools import cache
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.dictionary import table
from tipforce.dictionary.dbc import dbc_text
from tipforce.dictionary.signals import rpdo_messages, tpdo_messages
from tipforce.errors import InputError

STATUS = [name for name, _ in table.STATUS_BITS]


@cache
def _load() -> Any:
    import cantools  # slow, and only this file needs it

    return cantools.database.load_string(dbc_text(), "dbc", strict=True)


def _decode(name: str, data: bytes, **options: Any) -> dict[str, Any]:
    decoded: dict[str, Any] = _load().decode_message(name, data, **options)
    return decoded


def test_messages_and_nodes() -> None:
    db = _load()
    frames = {m.name: m.frame_id for m in db.messages}
    assert len(frames) == len(set(frames.values())) == 15 * 7 + 2
    assert [n.name for n in db.nodes] == ["HOST"] + [f"TIP{k:02d}" for k in range(1, 16)]
    assert frames["TIP05_Gauges"] == 0x185
    assert frames["TIP05_Contact"] == 0x285
    assert frames["TIP05_Force"] == 0x385
    assert frames["TIP05_Health"] == 0x485
    assert frames["TIP05_Command"] == 0x205
    assert frames["TIP05_EMCY"] == 0x085
    assert frames["TIP15_Heartbeat"] == 0x70F
    assert (frames["NMT"], frames["SYNC"]) == (0, 0x80)
    assert db.get_message_by_name("SYNC").length == 0
    assert db.get_message_by_name("TIP05_Contact").senders == ["TIP05"]
    assert db.get_message_by_name("TIP05_Command").senders == ["HOST"]


def test_layout_is_that_of_the_signals_module() -> None:
    db = _load()
    for pdo in tpdo_messages(3) + rpdo_messages():
        message = db.get_message_by_name(f"TIP09_{pdo.name}")
        assert (message.frame_id, message.length) == (pdo.cob_id_base + 9, pdo.length_bytes)
        assert len(message.signals) == len(pdo.signals)
        for signal in pdo.signals:
            found = message.get_signal_by_name(signal.name)
            assert (found.start, found.length, found.is_signed) == (signal.start_bit, signal.bits, signal.signed)
            assert (found.scale, found.minimum, found.maximum) == (signal.scale, signal.minimum, signal.maximum)
            assert (found.unit or "") == signal.unit
            assert found.comment == signal.description
            if signal.unknown is not None:
                assert {int(k): str(v) for k, v in found.choices.items()} == {signal.unknown: "unknown"}
                assert "unknown" in found.comment


def test_contact_frame_by_hand() -> None:
    decoded = _decode("TIP05_Contact", bytes.fromhex("F401E80300800305"))
    assert decoded["P"] == 0.5
    assert decoded["phi"] == 10.0
    assert decoded["theta"] == "unknown"
    assert [name for name in STATUS if decoded[name]] == ["contact", "calibrated"]
    assert decoded["counter"] == 5


def test_health_frame_by_hand() -> None:
    decoded = _decode("TIP01_Health", bytes.fromhex("0080FFFF02050711"))
    assert decoded["temperature"] == "unknown"
    assert decoded["u_P"] == "unknown"
    faults = {k for k, v in decoded.items() if "fault" in k and v}
    assert faults == {"SG2_fault", "fault_no_data", "fault_wire_break"}
    assert (decoded["configuration_counter"], decoded["error_register"]) == (7, 0x11)
    decoded = _decode("TIP01_Health", struct.pack("<hHHBB", 2315, 12, 0, 0, 0))
    assert decoded["temperature"] == pytest.approx(23.15)
    assert decoded["u_P"] == pytest.approx(0.012)


def test_services_by_hand() -> None:
    assert _decode("TIP03_Heartbeat", b"\x05")["state"] == "operational"
    assert _decode("TIP03_Heartbeat", b"\x7f")["state"] == "pre-operational"
    assert _decode("TIP03_Heartbeat", b"\x85") == {"state": "operational", "toggle": 1}
    emcy = _decode("TIP03_EMCY", bytes.fromhex("1050810102030405"))
    assert (emcy["error_code"], emcy["error_register"]) == ("gauge saturated", 0x81)
    assert [emcy[f"manufacturer_{k}"] for k in range(1, 6)] == [1, 2, 3, 4, 5]
    assert _decode("NMT", b"\x01\x00") == {"command": "start", "node": "all"}
    assert _decode("TIP03_Command", b"\x03\x00") == {"command": "zero gauges"}


@settings(derandomize=True, max_examples=100, deadline=None)
@given(st.sampled_from(["Gauges", "Contact", "Force", "Health"]), st.binary(min_size=8, max_size=8))
def test_any_frame_goes_round(name: str, data: bytes) -> None:
    """Through names and values and back: all bits return that a signal covers."""
    message = _load().get_message_by_name(f"TIP05_{name}")
    covered = sum(((1 << s.length) - 1) << s.start for s in message.signals)
    decoded = message.decode(data)
    again = message.encode(decoded, strict=False)
    assert int.from_bytes(again, "little") == int.from_bytes(data, "little") & covered


@pytest.mark.parametrize("n", range(3, 9))
def test_other_hands(n: int) -> None:
    import cantools

    db: Any = cantools.database.load_string(dbc_text([1, 127], n), "dbc", strict=True)
    assert {m.name for m in db.messages if m.name.startswith("TIP127_")} == {
        f"TIP127_{name}" for name in ("Gauges", "Contact", "Force", "Health", "Command", "EMCY", "Heartbeat")
    }


@pytest.mark.parametrize("ids", [[0], [128], [1, 1]])
def test_node_ids_outside(ids: list[int]) -> None:
    with pytest.raises(InputError, match=f"node-id {ids[0]}: allowed are 1 to 127, each once"):
        dbc_text(ids)
