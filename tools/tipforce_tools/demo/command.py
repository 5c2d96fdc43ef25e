"""`tipforce demo`: run the job, print a table of estimates and true loads, and check the errors."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING

from tipforce_tools.cli.common import (
    add_output_arguments,
    note,
    print_json,
    print_table,
    progress,
    seed,
)
from tipforce_tools.view.command import add_page_arguments

if TYPE_CHECKING:
    from tipforce_tools.demo.job import Result

DEFAULT_SEED = 20261121


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce demo`."""
    parser.epilog = (
        "Every error must lie inside its bound: z x standard uncertainty (z for a family-wise error of 1e-6 over all\n"
        "comparisons) + half a count of each gauge, propagated + half a step of the PDO's resolution. Otherwise the\n"
        "exit code is 1."
    )
    parser.add_argument("--seed", type=seed, default=DEFAULT_SEED, help="of the simulated noise (default %(default)s)")
    parser.add_argument(
        "--spoil", action="store_true", help="corrupt one element of each calibration matrix: the demo must fail"
    )
    parser.add_argument("--view", action="store_true", help="instead, serve a web page with a moving simulated hand")
    add_page_arguments(parser)
    add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run the demo; return 0 if every error is inside its bound and the host agrees with the nodes, otherwise 1."""
    if args.view:
        return _view(args)
    from tipforce.sensor.structure.layouts import CASES
    from tipforce.sensor.structure.published import GROOVES_DEG
    from tipforce_tools.demo.job import run_demo

    started_s = time.monotonic()
    results: list[Result] = []
    with progress(args, "loads", 2 * len(GROOVES_DEG)) as advance:
        for result in run_demo(args.seed, args.spoil, lambda line: note(args, line), advance):
            results.append(result)
            if args.json:
                print_json(_record(result))
    if not args.json:
        _print_tables(args, results, CASES)
    return _summary(args, results, time.monotonic() - started_s)


def _view(args: argparse.Namespace) -> int:
    """Serve the page with a simulated hand until Ctrl-C."""
    from tipforce_tools.cli.listening import commissioned
    from tipforce_tools.demo.hand import simulated_hand
    from tipforce_tools.view.command import page_guard, serve
    from tipforce_tools.view.sources import LiveSource

    guard = page_guard(args)
    with simulated_hand() as (hand, _):
        return serve(args, LiveSource(commissioned(args, hand), "simulated hand"), guard)


def _record(result: Result) -> dict[str, object]:
    record: dict[str, object] = {"case": result.case, "sense": result.sense}
    for name, triple in (
        ("applied", result.applied),
        ("estimated", result.estimated),
        ("error", result.error),
        ("u", result.u),
        ("bound", result.bound),
        ("host", result.host),
        ("host_bound", result.host_bound),
    ):
        for quantity, value in zip(("P_N", "phi_deg", "theta_deg"), triple, strict=True):
            record[f"{name}_{quantity}"] = float(value)
    record["inside"], record["host_agrees"] = result.inside, result.host_agrees
    return record


def _print_tables(args: argparse.Namespace, results: list[Result], cases: tuple[str, ...]) -> None:
    from rich.table import Table

    for case in cases:
        table = Table(
            title=f"Case {case}: applied, estimated by the node, error, standard uncertainty", title_justify="left"
        )
        for heading in (
            "sense",
            "P N",
            "est",
            "err",
            "u",
            "phi deg",
            "est",
            "err",
            "u",
            "theta deg",
            "est",
            "err",
            "u",
            "",
        ):
            table.add_column(heading, justify="right")
        for result in (r for r in results if r.case == case):
            cells = [result.sense]
            for k, digits in enumerate((3, 2, 2)):
                cells += [
                    f"{result.applied[k]:g}",  # short, so that the table fits 80 columns
                    f"{result.estimated[k]:.{digits}f}",
                    f"{result.error[k]:+.{digits}f}",
                    f"{result.u[k]:.{digits}f}",
                ]
            good = result.inside and result.host_agrees
            table.add_row(*cells, "ok" if good else "OUT", style=None if good else "bold red")
        print_table(args, table)


def _summary(args: argparse.Namespace, results: list[Result], elapsed_s: float) -> int:
    import numpy as np

    errors = np.array([result.error for result in results])
    share = np.array([np.abs(result.error) / result.bound for result in results])
    outside = sum(not result.inside for result in results)
    disagree = sum(not result.host_agrees for result in results)
    ok = outside == 0 and disagree == 0
    rms = np.sqrt(np.mean(errors**2, axis=0))
    if args.json:
        print_json(
            {
                "summary": True, "ok": ok, "loads": len(results), "outside": outside, "host_disagrees": disagree,
                "rms_P_N": float(rms[0]), "rms_phi_deg": float(rms[1]), "rms_theta_deg": float(rms[2]),
                "largest_share_of_bound": float(np.max(share)), "seed": args.seed,
            }
        )  # fmt: skip
        return 0 if ok else 1
    print(
        f"{len(results)} loads of 4.4 N on 3 nodes: RMS error P {rms[0]:.4f} N, phi {rms[1]:.3f} deg, "
        f"theta {rms[2]:.3f} deg; largest error {100 * np.max(share):.0f} % of its bound"
    )
    print(f"errors outside their bound: {outside}; host estimates that differ from the node's: {disagree}")
    print(f"{'PASS' if ok else 'FAIL'} in {elapsed_s:.1f} s")
    return 0 if ok else 1
