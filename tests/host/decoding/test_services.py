"""CANopen services as text, and the events of a recording; SDO transfers of a real node, byte for byte."""

import numpy as np
import pytest

from host.bus_with_nodes import connected, finger
from tipforce.dictionary import objects as od
from tipforce.errors import SdoAbortError
from tipforce.host.decoding.services import BusEvents, Services
from tipforce.host.frames.frame_array import FrameArray, frame_array


def frames(*texts: str) -> FrameArray:
    """Frames in the form 285#0102, one a millisecond."""
    rows = []
    for k, text in enumerate(texts):
        identifier, _, data = text.partition("#")
        rows.append((1_000_000 * k, int(identifier, 16), bytes.fromhex(data)))
    return frame_array(rows)


@pytest.mark.parametrize(
    ("frame", "name", "node_id", "text"),
    [
        ("000#0105", "NMT", 5, "NMT start"),
        ("000#8100", "NMT", 0, "NMT reset node, all nodes"),
        ("080#", "SYNC", 0, "SYNC"),
        ("080#07", "SYNC", 0, "SYNC 7"),
        ("100#80D0FF03F22D", "TIME", 0, "TIME 2016-03-15T18:38:16.704"),
        ("705#00", "heartbeat", 5, "heartbeat boot-up"),
        ("705#85", "heartbeat", 5, "heartbeat operational"),  # with node guarding's toggle bit
        ("40000705#", "heartbeat", 5, "node guarding request"),
        ("085#3081110700000000", "EMCY", 5,
         "EMCY 0x8130 heartbeat lost, error register 0x11, data 07 00 00 00 00"),
        ("085#0000000000000000", "EMCY", 5, "EMCY no error, error register 0x00"),
        ("085#1023050000000000", "EMCY", 5, "EMCY 0x2310 current, device output, error register 0x05"),
        ("7E5#0401000000000000", "LSS", 0, "LSS switch all nodes to configuration"),
        ("7E5#43E8030000000000", "LSS", 0, "LSS select serial 1000"),
        ("7E5#4B05000000000000", "LSS", 0, "LSS identify serial up to 5"),
        ("7E5#5100000000800000", "LSS", 0, "LSS fastscan start"),
        ("7E5#510000000C1F0303", "LSS", 0, "LSS fastscan serial 0x0C000000, bit 31"),
        ("7E5#1107000000000000", "LSS", 0, "LSS configure node-id 7"),
        ("7E4#1101000000000000", "LSS", 0, "LSS configure node-id: refused"),
        ("7E4#5D0A000000000000", "LSS", 0, "LSS inquire serial = 10"),
    ],
)  # fmt: skip
def test_single_frames(frame: str, name: str, node_id: int, text: str) -> None:
    (found,) = Services().describe(frames(frame))
    assert found == (0, name, node_id, text)


def test_frames_of_no_service() -> None:
    others = frames("185#0102030405060708", "80000705#00", "20000004#00", "000#01", "705#0000", "605#40", "7E5#04")
    assert list(Services().describe(others)) == []


def told(*texts: str) -> list[str]:
    return [service.text for service in Services().describe(frames(*texts))]


def test_expedited_transfers_and_aborts() -> None:
    assert told(
        "605#4017100000000000", "585#4B171000E8030000", "605#2B171000F4010000", "585#6017100000000000",
        "605#4000300000000000", "585#8000300000000206", "605#4000310000000000", "585#4300310078563412",
    ) == [
        "SDO read heartbeat.producer_ms (0x1017:00)",
        "SDO heartbeat.producer_ms (0x1017:00) = 1000 ms",
        "SDO write heartbeat.producer_ms (0x1017:00) = 500 ms",
        "SDO written heartbeat.producer_ms (0x1017:00)",
        "SDO read 0x3000:00",
        "SDO abort by the node 0x3000:00: 0x06020000, object does not exist",
        "SDO read 0x3100:00",
        "SDO 0x3100:00 = 78 56 34 12",
    ]  # fmt: skip


def test_transfers_of_a_node() -> None:
    """Segmented and block transfers as the product's own client and server speak them."""
    with connected(finger(5)) as (connection, _):
        sdo = connection.sdo(5)
        connection.buffer.clear()
        name = sdo.read(od.DEVICE_NAME)
        record = sdo.upload(0x2140, 0)
        with pytest.raises(SdoAbortError):
            sdo.upload(0x1018, 9)
        received = connection.buffer.take_all()
    texts = [service.text for service in Services().describe(received)]
    assert texts[0].startswith("SDO device_name (0x1008:00): ")
    assert f"SDO read device_name (0x1008:00) = {name}" in texts
    assert any(text.endswith(f"... ({len(record)} bytes)") for text in texts)
    assert texts[-1] == "SDO abort by the node 0x1018:09: 0x06090011, sub-index does not exist"


def test_block_transfers() -> None:
    content = bytes(range(20))
    upload = ["605#A000300005000000", "585#C200300014000000", "605#A300000000000000"]
    segments = [f"585#{k + 1 | (0x80 if k == 2 else 0):02X}{content[7 * k : 7 * k + 7].ljust(7, b'X').hex()}"
                for k in range(3)]  # fmt: skip
    texts = told(*upload, *segments, "605#A203050000000000", "585#C500000000000000", "605#A100000000000000")
    assert texts[5] == "SDO block 0x3000:00: segment 3, the last"
    assert texts[-2] == f"SDO block read 0x3000:00 = {content.hex(' ').upper()}"
    assert texts[-1] == "SDO block read 0x3000:00: end"
    requests = [frame.replace("585#", "605#") for frame in segments]
    texts = told("605#C200300014000000", "585#A000300005000000", *requests, "585#A203050000000000",
                 "605#C500000000000000", "585#A100000000000000")  # fmt: skip
    assert texts[-3:] == [
        "SDO block write 0x3000:00: segments received",
        f"SDO block write 0x3000:00 = {content.hex(' ').upper()}",
        "SDO block written 0x3000:00",
    ]


def test_no_frame_is_a_reason_to_fail() -> None:
    random = np.random.default_rng(16)
    rows = [
        (k, int(random.choice([0x605, 0x585, 0x7E4, 0x7E5, 0x085, 0x705, 0x100, 0x000])), random.bytes(int(size)))
        for k, size in enumerate(random.choice([0, 1, 6, 8, 8, 8, 8], 5000))
    ]
    described = list(Services().describe(frame_array(rows)))
    assert len(described) > 1000
    assert all(service.text.isprintable() for service in described)


def test_events_are_changes() -> None:
    events = BusEvents(node_ids=[5])
    for block in (
        frames("705#00", "705#7F", "705#7F", "085#3081110000000000"),
        frames("705#7F", "705#05", "706#05", "080#", "085#0000000000000000", "705#00"),
    ):
        events.add(block, ["can0"])
    assert [(event.t_ns, event.node_id, event.kind, event.code) for event in events.found] == [
        (0, 5, "boot_up", 0), (1_000_000, 5, "state", 127), (3_000_000, 5, "emcy", 0x8130),
        (1_000_000, 5, "state", 5), (4_000_000, 5, "emcy_reset", 0), (5_000_000, 5, "boot_up", 0),
    ]  # fmt: skip
    assert events.found[2].text == "0x8130 heartbeat lost, error register 0x11"
