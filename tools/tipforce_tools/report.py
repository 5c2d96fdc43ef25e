"""`tipforce report`: error against run time, and the behaviour in extreme cases."""

import argparse
import datetime
from pathlib import Path

from tipforce_tools.cli import common, tables


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Error against run time compares methods for one task with a reference of stated error. A time is the median of
    several runs with its quartiles: compare times within one run, on an otherwise idle machine. The extreme cases,
    recorded by the tests of this version, state what holds where numbers can go bad: pass, bounded, flagged, refused.
    Studies that lack packages are left out: pip install "tipforce[report]". Exit code 1: a claim did not hold, or a
    study failed.
      tipforce report --only decoders,contact --json
    """
    parser.add_argument("--quick", action="store_true", help="less of all: 75 s of processor time, not ten minutes")
    parser.add_argument("--only", metavar="KEY[,KEY]", help="studies, stability, or cases by key, area or pattern")
    parser.add_argument("--list", action="store_true", help="list studies and cases without running them")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="write a page, report.jsonl and plots there")
    parser.add_argument("--seed", type=common.whole_number, metavar="N", help="of all random numbers (default: fixed)")
    parser.add_argument("--date", metavar="TEXT", help="date printed in the report (default: now)")
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run and print; return 1 if a claim did not hold. Raises EnvironmentLackError for -o without matplotlib."""
    from tipforce_lab.report import text
    from tipforce_lab.report.study import Effort, Run, selected

    if args.list:
        _print_list()
        return 0
    effort = Effort(args.quick) if args.seed is None else Effort(args.quick, args.seed)
    if args.output is not None:  # before minutes of work: matplotlib and the folder of the page
        from tipforce.output_file import make_folder
        from tipforce_lab.report.page import plotting, write

        with plotting():
            make_folder(args.output)
    date = args.date or datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    job = Run(selected(args.only), effort, date)
    if common.OUTPUT.json:
        common.print_json(text.head_record(job.report))
    # The bar is drawn in a thread: two updates a second do not disturb the timings.
    with common.progress("report", job.steps, refresh_hz=2.0) as advance:
        for item in job.items(advance):
            if common.OUTPUT.json:
                common.print_json(text.record(item))
    if common.OUTPUT.json:
        common.print_json({"record": "verdict", **text.conclusions(job.report)})
        common.note(text.summary(job.report))
    else:
        text.print_report(tables.console(), job.report)
    if args.output is not None:
        page, *others = write(job.report, args.output, common.json_line)
        common.note(f"written: {page}, and {len(others)} more files")
    return 0 if job.report.sound() else 1


def _print_list() -> None:
    from tipforce_lab.report.study import STABILITY, STUDIES, all_cases

    rows = [(key, "study", what) for key, (_, what) in STUDIES.items()]
    rows.append((STABILITY, "cases", "all cases below"))
    rows += [(case.key, case.outcome, case.situation) for case in all_cases()]
    for key, kind, what in rows:
        common.print_record({"key": key, "kind": kind, "what": what}, f"{key:36} {kind:8} {what}")
