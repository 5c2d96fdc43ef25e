"""`tipforce hand check|up|run FILE`: commission and run a hand defined in a TOML file."""

from __future__ import annotations

import argparse
import math
import sys
import time
from typing import TYPE_CHECKING, TextIO

from tipforce.errors import EnvironmentLackError
from tipforce_tools.cli import bus_flags, common
from tipforce_tools.cli.actions import add_choice
from tipforce_tools.cli.listening import note_missing

if TYPE_CHECKING:
    from tipforce.host.hand.bring_up import FingerReport
    from tipforce.host.hand.events import Event
    from tipforce.host.hand.file import HandFile
    from tipforce.host.hand.hand import Hand
    from tipforce.host.hand.rows import HandRow

QUIET_EVENTS = ("found", "configured", "calibrated", "verified", "started", "state")
"""Shown on stderr with -v only."""
ACTIONS = {
    "check": "read the file and those that it names, compute the bus load; compare serial numbers, if there is a bus",
    "up": "find the fingers, assign node-ids by LSS, configure, verify, calibrate, start; exit code 1 if one failed",
    "run": "as up, then SYNC, rows and events until Ctrl-C; a finger that reboots is configured again",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The file (docs/hand.md has all keys):

      [hand]
      sync_hz = 500              # 0: another device sends the SYNC
      pdos = ["contact"]         # any of gauges, contact, force
      config = "finger.toml"     # settings of all fingers, from tipforce config save

      [[finger]]
      name = "thumb"
      node_id = 1
      serial = 1005              # 1018h:4: LSS assigns the node-id by it
      calibration = "thumb.toml" # from tipforce calibrate fit -o

      tipforce hand run hand.toml --json -i socketcan -c vcan0 | head
    `tipforce view hand.toml` shows it in a browser.
    """
    add_choice(parser, "action", ACTIONS)
    parser.add_argument("file", type=common.InputFile(), metavar="FILE", help="hand.toml")
    parser.add_argument("--seconds", type=common.seconds, metavar="S", help="run: end after this time")
    bus_flags.add_bus_arguments(parser, confirm=True)


def run(args: argparse.Namespace) -> int:
    """Run the action; return 0, or for up and run 1 if a finger failed."""
    from tipforce.host.hand.file import read_hand

    file = read_hand(args.file)
    if args.action == "check":
        return _check(args, file)
    _note_load(file, bus_flags.bus_options(args).get("bitrate"), budgeted=False)
    if file.hand.store:
        bus_flags.confirm(args, f"{args.file}: store = true replaces the stored parameters of the fingers")
    return _up(args, file)


def _check(args: argparse.Namespace, file: HandFile) -> int:
    """Print the fingers; say on stderr where nodes of a bus, if there is one, differ; return 1 for swapped ones."""
    from tipforce.host.hand.bring_up import wanted_settings
    from tipforce.host.network.bus import Bus
    from tipforce.host.network.find import find_nodes
    from tipforce.host.network.interfaces import open_bus
    from tipforce.watching.findings import MISSING, Observed, findings

    for finger in file.finger:
        calibration = file.calibration(finger)
        crc = "" if calibration is None else f"0x{calibration.crc32():08X}"
        settings = len(wanted_settings(file, finger))
        own = f"{finger.calibration} {crc}" if crc else "keeps its own calibration"
        serial = f"serial {finger.serial}" if finger.serial else "any serial"
        common.print_record(
            {"node_id": finger.node_id, "name": finger.name, "serial": finger.serial, "settings": settings,
             "calibration": finger.calibration, "crc32": crc},
            f"{common.shown_id(finger.node_id):>11}  {finger.name:10} {serial:17} {settings} settings, {own}",
        )  # fmt: skip
    _note_load(file, bus_flags.bus_options(args).get("bitrate"), budgeted=True)
    try:
        options = bus_flags.find_bus(args, file.bus)
        with Bus(open_bus(**options)) as connection:
            seen = Observed(duplicates=connection.duplicates)
            seen.add_nodes(find_nodes(connection, file.node_ids))
    except EnvironmentLackError:
        if bus_flags.bus_options(args):
            raise
        return 0
    seen.calibrated.clear()  # `hand up` calibrates
    wrong = [finding for finding in findings(seen, wanted=file.finger) if finding.topic != "faults"]
    for finding in wrong:
        common.note(str(finding))
    return 1 if any(finding.topic != MISSING for finding in wrong) else 0


def _note_load(file: HandFile, bit_rate: int | None, budgeted: bool) -> None:
    """Print the bus load, of one above 80 % or where ``budgeted`` also that of each kind of frame, and what fits."""
    from tipforce.host.network.bus_load import DEFAULT_BIT_RATE, LIMIT, budget_lines, hand_budget, what_fits

    if not file.hand.sync_hz:
        return
    count, gauges = len(file.finger), file.finger[0].gauges
    bit_rate = int(bit_rate or file.bus.get("bitrate") or DEFAULT_BIT_RATE)
    pdos, heartbeat_s = file.messages, 1e-3 * file.hand.heartbeat_ms
    budget = hand_budget(count, file.hand.sync_hz, (*pdos, "Health"), gauges, bit_rate, heartbeat_s)
    share = f"{100 * budget.least_load:.0f} to {100 * budget.most_load:.0f} % of {bit_rate} bit/s"
    fits = budget.most_load <= LIMIT
    warning = f"warning: {count} fingers at {file.hand.sync_hz:g} Hz take {share}: rows will be late or lost"
    lines = [f"bus load {share}" if fits else warning]
    if budgeted or not fits:
        lines += [*budget_lines(budget), f"what fits under {100 * LIMIT:.0f} %:"]
        lines += what_fits(count, file.hand.sync_hz, pdos, gauges, bit_rate, heartbeat_s)
    common.note("\n".join(lines))


def _up(args: argparse.Namespace, file: HandFile) -> int:
    from tipforce.host.hand.hand import Hand

    with Hand.from_file(file, **bus_flags.find_bus(args, file.bus)) as hand:
        as_rows = args.action == "run"
        reports: list[FingerReport] = []

        def show(event: Event) -> None:
            as_json = common.OUTPUT.json and as_rows
            if reports or as_json or event.kind != "failed":  # the report of the bring-up says what failed in it
                _print_event(hand, event, as_json)

        hand.on_event(show)
        started_s = time.monotonic()
        reports += hand.bring_up()
        _print_reports(reports, sys.stderr if as_rows else sys.stdout, time.monotonic() - started_s)
        failed = any(not report.ok for report in reports)
        if as_rows:
            try:
                _rows(hand, args.seconds)
            except KeyboardInterrupt:
                pass
            finally:
                _note_statistics(hand)
    return 1 if failed else 0


def _print_reports(reports: list[FingerReport], stream: TextIO, elapsed_s: float) -> None:
    for report in reports:
        if common.OUTPUT.json and stream is sys.stdout:
            record = {"node_id": report.plan.node_id, "name": report.plan.name, "ok": report.ok, "done": report.done}
            texts = {name: getattr(report, name) or None for name in ("failed", "error", "note")}
            common.print_json({**record, **texts, "seconds": report.seconds})
        else:
            print(report, file=stream)
        note_missing(report)
    common.note(f"{sum(report.ok for report in reports)} of {len(reports)} fingers up in {elapsed_s:.1f} s")


def _print_event(hand: Hand, event: Event, as_json: bool) -> None:
    labels = {finger.node_id: (finger.name, finger.label) for finger in hand.file.finger}
    name, label = labels.get(event.node_id, ("", "bus"))
    if as_json:
        record = {"event": event.kind, "t_s": time.time() - time.monotonic() + event.t_s, "node_id": event.node_id}
        common.print_json(record | {"name": name, "text": event.text})
        sys.stdout.flush()
    elif common.OUTPUT.verbose or event.kind not in QUIET_EVENTS:
        common.note(f"{label}: {event.kind.replace('_', ' ')}: {event.text}")
        sys.stderr.flush()


def _rows(hand: Hand, seconds: float | None) -> None:
    from tipforce.host.hand.rows import rows_one_by_one
    from tipforce.samples.record import RowContacts

    hand.start()
    deadline_s = None if seconds is None else time.monotonic() + seconds
    shown_s = 0.0
    made = RowContacts(hand.node_ids, [finger.name for finger in hand.file.finger])
    for rows in hand.blocks(seconds):
        if common.OUTPUT.json:
            for row, contacts in enumerate(rows_one_by_one(rows, made)):
                record: dict[str, object] = {"row": contacts.number, "t_s": contacts.t_s, "pairing": contacts.pairing}
                for k, contact in enumerate(contacts.contacts):  # a missing finger has no columns
                    columns = {} if rows.missing[row, k] else {n: c[row, k].item() for n, c in rows.columns.items()}
                    record[str(contact.node_id)] = {"name": contact.name, **columns, "reason": contact.reason}
                common.print_json(record)
            sys.stdout.flush()  # a reader has the rows at any SYNC rate
        elif time.monotonic() - shown_s >= 1.0:
            shown_s = time.monotonic()
            print(_line(hand, rows_one_by_one(rows, made)[-1]), flush=True)
        if deadline_s is not None and time.monotonic() >= deadline_s:
            break


def _line(hand: Hand, row: HandRow) -> str:
    from tipforce.samples.reasons import Status

    parts = []
    for contact in row.contacts:
        values = ("P", contact.P_newtons, "N"), ("phi", contact.phi_deg, "deg"), ("theta", contact.theta_deg, "deg")
        words = [f"{name} {value:.2f} {unit}" for name, value, unit in values if math.isfinite(value)]
        reason = contact.reason
        if Status.NO_ANSWER in contact.status and not contact.missing:
            reason += f" ({hand.state(contact.node_id)})"
        words += [f"({reason})"] if reason and words else [reason] if reason else []
        parts.append(f"{contact.name}: " + " ".join(words))
    return " | ".join(parts)


def _note_statistics(hand: Hand) -> None:
    statistics = hand.statistics()
    tally, sync = statistics.tally, statistics.sync
    deviations = f"deviation p50 {sync.p50_us:g}, p99 {sync.p99_us:g}, largest {sync.largest_us:g} us"
    period = f"SYNC period {sync.mean_period_us:.1f} us, {deviations}" if sync.periods else "no SYNC period"
    low, high = (100 * load for load in statistics.load)
    frames = f"{statistics.dropped} frames dropped; bus load at the end {low:.0f} to {high:.0f} %"
    common.note(f"{tally.rows} rows; {period}; {frames}")
    for k, finger in enumerate(hand.file.finger):
        names = ("missing", "delayed", "late", "mixed", "doubtful", "changed", "repeated")
        counts = ", ".join(f"{name} {int(getattr(tally, name)[k])}" for name in names)
        common.note(f"  {finger.label}: {counts}")
