"""`decode -o run.mcap`: mcap and mcap-ros2-support read it, its values are those of the CSV, and it is a log."""

import bisect
import json
import math
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory

import tipforce
from host.bus_with_nodes import beam_calibration
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.logs.reader import open_log
from tipforce.samples import reasons
from tipforce.watching.feeds import Finger
from tipforce_robots.mcap_file import McapWriter
from tipforce_robots.ros2 import cdr
from tipforce_tools.cli.main import main
from tipforce_tools.page.sources import LogSource
from tools.decode.logs import START_US, decode, log_lines, number, rows_of, write_log
from tools.rig import Printed

Found = dict[str, list[tuple[int, Any]]]
EMCY = "(1700000000.100010) vcan0 085#3050100000000000"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with run.log, run.mcap and run.csv of two nodes for 1.5 s, an EMCY and a frame with 29 bits."""
    folder = tmp_path_factory.mktemp("mcap")
    lines = log_lines(1200, (1, 5), health=40)
    lines[700:700] = [EMCY, "(1700000000.100011) vcan0 12345678#0102"]
    log = write_log(folder / "run.log", lines)
    for suffix in (".mcap", ".csv"):
        assert decode(log, "-o", log.with_suffix(suffix)) == 0
    return folder


@pytest.fixture(scope="module")
def found(files: Path) -> Found:
    return _messages(files / "run.mcap")


def _messages(path: Path) -> Found:
    """The messages by topic, each with its log time; the reader checks the CRCs."""
    topics: Found = {}
    factory = DecoderFactory()
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        header, summary = reader.get_header(), reader.get_summary()
        assert (header.profile, header.library) == ("ros2", "tipforce")
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            decoder = factory.decoder_for(channel.message_encoding, schema)
            value = json.loads(message.data) if decoder is None else decoder(message.data)
            topics.setdefault(channel.topic, []).append((message.log_time, value))
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == sum(map(len, topics.values()))
    return topics


def test_topics_are_those_of_the_command_ros2(found: Found) -> None:
    fingers = {f"/tipforce/finger_{node}/{what}" for node in (1, 5) for what in ("wrench", "contact")}
    assert set(found) == fingers | {"/diagnostics", "/tipforce/scene", "/vcan0/frames"}


@pytest.mark.parametrize("node", [1, 5])
def test_every_value_is_that_of_the_csv(node: int, found: Found, files: Path) -> None:
    names = ("P_N", "phi_deg", "theta_deg", "SG1_ue", "SG2_ue", "SG3_ue")
    carried = ("contact", "SG1_ue")  # a row of TPDO4 alone has no contact
    rows = [
        row for row in rows_of(files / "run.csv") if row["node"] == str(node) and any(row[name] for name in carried)
    ]
    contacts = found[f"/tipforce/finger_{node}/contact"]
    assert len(contacts) == len(rows) > 1100
    wrenches = dict(found[f"/tipforce/finger_{node}/wrench"])
    for row, (t_ns, contact) in zip(rows, contacts, strict=True):
        values = [math.nan if (cell := number(row[name])) is None else cell for name in names]
        written = [contact.force, math.degrees(contact.direction), math.degrees(contact.angle), *contact.microstrain]
        np.testing.assert_allclose(written, values, rtol=1e-12, atol=1e-9)
        assert (t_ns, contact.number) == (round(float(row["t_s"]) * 1e6) * 1000, int(row["counter"]))
        assert contact.header.stamp.sec * 10**9 + contact.header.stamp.nanosec == t_ns
        assert bool(contact.status & 1) == (row["contact"] == "1")
        assert (t_ns in wrenches) == all(map(math.isfinite, values[:3]))
        if t_ns in wrenches:
            P, phi = values[0], math.radians(values[1])
            force = wrenches[t_ns].wrench.force
            np.testing.assert_allclose([force.x, force.y], [P * math.cos(phi), P * math.sin(phi)], atol=1e-12)


def test_the_flags_of_a_calibration_are_bits_of_the_status(tmp_path: Path) -> None:
    """A flag that is computed has its own bit: 0100h says that no answer came, and the calibration has no range."""
    write_calibration(tmp_path / "cal.toml", beam_calibration(pull=True))
    log = write_log(tmp_path / "run.log", [f"(1700000000.{k:06d}) can0 185#640{k}6400640003{k:02X}" for k in range(9)])
    for name in ("run.mcap", "run.csv"):
        assert decode(log, "--calibration", f"5={tmp_path / 'cal.toml'}", "-o", tmp_path / name) == 0
    contacts = _messages(tmp_path / "run.mcap")["/tipforce/finger_5/contact"]
    for row, (_, contact) in zip(rows_of(tmp_path / "run.csv"), contacts, strict=True):
        assert contact.status == sum(bit for name, bit in reasons.BITS.items() if row.get(name) == "1")
        assert contact.status & reasons.UNRANGED
        assert not contact.status & reasons.NO_ANSWER


def test_diagnostics_come_once_a_second_and_with_an_emcy(found: Found) -> None:
    levels = [(t_ns, [one.level for one in message.status]) for t_ns, message in found["/diagnostics"]]
    first = START_US * 1000
    assert [len(level) for _, level in levels] == [2, 1, 2]
    assert levels[1][0] == first + 100_010_000
    assert first + 990_000_000 < levels[0][0] < first + 1_000_000_000
    assert "emcy: " in found["/diagnostics"][1][1].status[0].message


def test_the_drawing_shows_the_force_or_why_there_is_none(found: Found) -> None:
    pictures = found["/tipforce/scene"]
    assert set(np.diff([t_ns for t_ns, _ in pictures]).tolist()) == {10**9 // 30}
    drawn = 0
    for t_ns, picture in pictures[1:]:
        for entity in picture["entities"]:
            name = entity["id"]
            contacts = found[f"/tipforce/{name}/contact"]
            at = bisect.bisect_right(contacts, t_ns, key=itemgetter(0))
            # The last can come in the next block.
            expected = [_drawn(contact) for _, contact in contacts[max(0, at - 2) : at]]
            turns = [arrow["pose"]["orientation"] for arrow in entity["arrows"]]
            cosines = [math.cos(2.0 * math.atan2(turn["z"], turn["w"])) for turn in turns]
            lengths = [arrow["shaft_length"] + arrow["head_length"] for arrow in entity["arrows"]]
            arrows = list(zip(lengths, cosines, strict=True))
            assert any(arrows == one for one in expected)
            drawn += len(arrows)
            assert entity["texts"][0]["text"].startswith(f"{name}: ")
    assert drawn > 10


def _drawn(contact: Any) -> list[Any]:
    """Length of the arrow and cosine of its direction; none without a force."""
    known = all(map(math.isfinite, (contact.force, contact.direction, contact.angle)))
    return [pytest.approx((0.005 * contact.force, math.cos(contact.direction)))] if known and contact.force > 0 else []


def test_it_is_a_log_of_the_same_frames(files: Path) -> None:
    with open_log(files / "run.log") as text, open_log(files / "run.mcap") as packed:
        expected, read = (np.concatenate(list(log)) for log in (text, packed))
        assert packed.channels == text.channels == ["vcan0"]
    assert (read == expected).all()
    assert decode(files / "run.mcap", "-o", files / "again.csv") == 0
    assert (files / "again.csv").read_bytes() == (files / "run.csv").read_bytes()


def test_plot_view_and_read_log_read_it(files: Path) -> None:
    log, again = tipforce.read_log(files / "run.log"), tipforce.read_log(files / "run.mcap")
    np.testing.assert_array_equal(again[5].P_newtons, log[5].P_newtons)
    pages = [LogSource(files / name, Finger).model for name in ("run.log", "run.mcap")]
    a, b = (page.rows_after(0, 10_000, 2**62) for page in pages)
    assert len(a) == len(b) > 1100
    np.testing.assert_array_equal(a.contact, b.contact)
    assert main(["plot", "-q", str(files / "run.mcap"), "-o", str(files / "run.svg"), "--signals", "P"]) == 0


@pytest.mark.parametrize("flag", ["--signals=P", "--eds=a.eds", "--dbc=hand.dbc"])
def test_what_it_cannot_hold_is_refused(flag: str, files: Path, printed: Printed) -> None:
    err = printed(2, f"decode {files}/run.log {flag} -o {files}/other.mcap").err
    assert err.startswith(f"tipforce: {flag.partition('=')[0]}: MCAP has whole contacts")


def test_a_file_of_other_messages_and_a_damaged_one(files: Path, printed: Printed) -> None:
    whole = (files / "run.mcap").read_bytes()
    (files / "short.mcap").write_bytes(whole[: len(whole) // 10])
    assert "short.mcap: truncated: " in printed(1, f"decode {files}/short.mcap").err
    (files / "half.mcap").write_bytes(whole[: len(whole) * 9 // 10])
    assert "half.mcap: truncated: " in printed(0, f"decode --summary {files}/half.mcap").err
    with (files / "other.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()  # type: ignore[no-untyped-call]
    assert "no CAN frames (can_msgs/msg/Frame) in it" in printed(1, f"decode {files}/other.mcap").err
    with (files / "one.mcap").open("wb") as stream:  # one message that is none, and a frame after it
        made = McapWriter(stream)
        place = made.channel("/can0/frames", cdr.FRAME)
        frame = {"id": 0x285, "is_rtr": False, "is_extended": False, "is_error": False, "dlc": 8, "data": bytes(8)}
        header = {"header": {"stamp": cdr.stamp(10**9), "frame_id": "can0"}}
        for data in (b"", cdr.encode(cdr.FRAME, header | frame)):
            made._add(place, 10**9, data)
        made.close([])
    assert "1 not CAN" in printed(0, f"decode {files}/one.mcap -o {files}/one.csv").err
    assert len(rows_of(files / "one.csv")) == 1
    write_log(files / "later.log", ["(2147483648.000000) can0 285#0102030405060708"])
    err = printed(2, f"decode {files}/later.log -o {files}/later.mcap").err
    assert "a time of 2147483648.000000 s: allowed in ROS 2 are 0 to 2147483647 s" in err
