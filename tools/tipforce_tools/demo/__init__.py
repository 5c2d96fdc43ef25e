"""`tipforce demo`: run the job, check the errors, and print what came out, with --table each load."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING

from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce_tools.demo.job import Result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Exit code 1 if an error is outside its bound: z x standard uncertainty (z for a family-wise error of 1e-6
    over all comparisons) + half a count of each gauge, propagated + half a step of the PDO's resolution."""
    what = "of the simulated noise (default %(default)s)"
    parser.add_argument("--seed", type=common.whole_number, default=20261121, help=what)
    parser.add_argument("--spoil", action="store_true", help="corrupt an element of each matrix: the demo must fail")
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument("--table", action="store_true", help="print each load: true, estimated, error, uncertainty")
    shown.add_argument("--view", action="store_true", help="instead, serve a web page with a moving simulated hand")
    common.add_page_arguments(parser)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run the demo; return 0 if every error is inside its bound and the host agrees with the nodes, otherwise 1."""
    if args.view:  # the scene of a hand, in a loop. Its time is simulated: no row is missing
        from tipforce.shipped_files import file_or_shipped
        from tipforce.watching.feeds import finger_maker
        from tipforce_tools.page.guard import page_guard
        from tipforce_tools.page.server import serve_page
        from tipforce_tools.page.sources import scene_source

        guard = page_guard(args)
        source = scene_source(file_or_shipped("hand", "scenes"), finger_maker())
        source.loops = True
        return serve_page(args, source, guard)
    from tipforce.sensor.structure.layouts import CASES, GROOVES_DEG
    from tipforce_tools.demo.job import run_demo

    started_s = time.monotonic()
    results: list[Result] = []
    with common.progress("loads", 2 * len(GROOVES_DEG)) as advance:
        for result in run_demo(args.seed, args.spoil, common.note, advance):
            results.append(result)
            if args.json:
                record: dict[str, object] = {"case": result.case, "sense": result.sense}
                for name in ("applied", "estimated", "error", "u", "bound", "host", "host_bound"):
                    for quantity, value in zip(("P_N", "phi_deg", "theta_deg"), getattr(result, name), strict=True):
                        record[f"{name}_{quantity}"] = float(value)
                common.print_json(record | {"inside": result.inside, "host_agrees": result.host_agrees})
    shown = [result for result in results if args.table or not (result.inside and result.host_agrees)]
    for case in () if args.json else CASES:
        of_case = [result for result in shown if result.case == case]
        if of_case:
            _print_table(case, of_case)
    return _summary(args, results, time.monotonic() - started_s)


def _print_table(case: str, results: list[Result]) -> None:
    from tipforce_tools.cli.tables import print_rows

    headings = [f">{word}" for name in ("P N", "phi deg", "theta deg") for word in (name, "est", "err", "u")]
    good = [result.inside and result.host_agrees for result in results]
    rows = []
    for result, ok in zip(results, good, strict=True):
        cells = [result.sense]
        for k, digits in enumerate((3, 2, 2)):
            error = f"{result.error[k]:+.{digits}f}"
            cells += [f"{result.applied[k]:g}", f"{result.estimated[k]:.{digits}f}", error, f"{result.u[k]:.{digits}f}"]
        rows.append([*cells, "ok" if ok else "OUT"])
    title = f"Case {case}: applied, estimated by the node, error, standard uncertainty"
    print_rows(title, [">sense", *headings, ">"], rows, [None if ok else "bold red" for ok in good])


def _summary(args: argparse.Namespace, results: list[Result], elapsed_s: float) -> int:
    import numpy as np

    errors = np.array([result.error for result in results])
    share = np.array([np.abs(result.error) / result.bound for result in results])
    outside = sum(not result.inside for result in results)
    disagree = sum(not result.host_agrees for result in results)
    ok = outside == 0 and disagree == 0
    rms = np.sqrt(np.mean(errors**2, axis=0))
    record = {
        "summary": True, "ok": ok, "loads": len(results), "outside": outside, "host_disagrees": disagree,
        "rms_P_N": float(rms[0]), "rms_phi_deg": float(rms[1]), "rms_theta_deg": float(rms[2]),
        "largest_share_of_bound": float(np.max(share)), "seed": args.seed,
    }  # fmt: skip
    text = (
        f"{len(results)} loads of 4.4 N on 3 nodes: RMS error P {rms[0]:.4f} N, phi {rms[1]:.3f} deg, "
        f"theta {rms[2]:.3f} deg; largest error {100 * np.max(share):.0f} % of its bound\n"
        f"errors outside their bound: {outside}; host estimates that differ from the node's: {disagree}\n"
        f"{'PASS' if ok else 'FAIL'} in {elapsed_s:.1f} s"
    )
    common.print_record(record, text)
    return 0 if ok else 1
