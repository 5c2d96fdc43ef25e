"""Output of `tipforce design optimise`: structures, their figures of merit, and conclusions."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import asdict, fields
from typing import TYPE_CHECKING

import numpy as np

from tipforce.sensor.calibration.validity import FALSE_ALARM_RATE
from tipforce.sensor.contact.redundancy import detectable_strain, parity, weighted_inverse
from tipforce.sensor.structure.gauge_positions import gauge_matrix, gauge_name
from tipforce_lab.design.merit import AGREEMENT, Assessment, Merit
from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce_tools.design.optimise import Outcome

_GEOMETRY = (("a", "a_m"), ("d", "d_m"), ("r", "r_m"), ("h1", "h1_m"), ("h2", "h2_m"), ("width", "width_m"))


def print_outcome(args: argparse.Namespace, outcome: Outcome) -> None:
    """Print tables and sentences, or JSON lines: one per structure, then the summary."""
    entries = [*outcome.paper, *outcome.front]
    if args.json:
        for entry in entries:
            common.print_json(_record(entry) | {"detectable_microstrain": _detectable(entry, args.noise)})
        common.print_json(_summary(args, outcome))
        return
    _print_structures(args, entries)
    _print_figures(args, entries)
    _print_frame(args, entries)
    print("\n".join(_sentences(args, outcome)))


def comment(args: argparse.Namespace, best: Assessment) -> str:
    """Return the first lines of the layout file: its command and its expected uncertainties."""
    merit = best.theory
    return (
        f"tipforce design optimise --objective {args.objective} --gauges {args.gauges} --seed {args.seed}\n"
        f"At {args.noise:g} microstrain noise per gauge and {args.load:g} N, RMS over the pad and the friction cone:\n"
        f"u(P) {1e3 * merit.u_P_newtons:.3g} mN, u(phi) {merit.u_phi_deg:.3g} deg, u(theta) {merit.u_theta_deg:.3g} "
        f"deg; condition number {merit.condition_number:.3f}; worst stress {best.worst_stress_pascals * 1e-6:.0f} MPa"
    )


def _print_structures(args: argparse.Namespace, entries: list[Assessment]) -> None:
    from rich.table import Table

    table = Table(title="Structures, mm; gauges: beam, side, middle of the gauge from the joint", title_justify="left")
    table.add_column("")
    for symbol, _ in _GEOMETRY:
        table.add_column(symbol, justify="right")
    table.add_column("SG1, SG2, ...")
    for entry in entries:
        lengths = (f"{1e3 * getattr(entry.geometry, name):.3f}" for _, name in _GEOMETRY)
        table.add_row(entry.name, *lengths, ", ".join(gauge_name(gauge) for gauge in entry.gauges))
    common.print_table(args, table)


def _print_figures(args: argparse.Namespace, entries: list[Assessment]) -> None:
    title = f"Standard uncertainties at {args.noise:g} microstrain and {args.load:g} N, and limits of the body"
    headings = ("u(P) mN", "u(phi) deg", "u(theta) deg", "mN per ue", "least ue/N", "cond", "MPa", "slit shuts N")
    rows = (
        (
            *_figures(entry.theory), f"{1e3 * entry.theory.noise_gain_newtons:.2f}",
            f"{entry.theory.smallest_singular_value:.1f}", f"{entry.theory.condition_number:.3f}",
            f"{entry.worst_stress_pascals * 1e-6:.0f}", f"{entry.slit_load_newtons:.1f}",
        )
        for entry in entries
    )  # fmt: skip
    _print_table(args, title, headings, entries, rows)


def _print_frame(args: argparse.Namespace, entries: list[Assessment]) -> None:
    title = "The same by the frame: shear and elastic roots; then with the joint a block h2 wide as well"
    headings = ("u(P) mN", "u(phi) deg", "u(theta) deg", "cond", "differs %", "block: u(theta)", "cond")
    rows = (
        (
            *_figures(entry.frame), f"{entry.frame.condition_number:.3f}", f"{100 * entry.disagreement:.2f}",
            f"{entry.frame_finite_joint.u_theta_deg:.4f}", f"{entry.frame_finite_joint.condition_number:.3f}",
        )
        for entry in entries
    )  # fmt: skip
    _print_table(args, title, headings, entries, rows)


def _print_table(
    args: argparse.Namespace,
    title: str,
    headings: Iterable[str],
    entries: list[Assessment],
    rows: Iterable[Iterable[str]],
) -> None:
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    table.add_column("")
    for heading in headings:
        table.add_column(heading, justify="right")
    for entry, row in zip(entries, rows, strict=True):
        table.add_row(entry.name, *row, style=None if entry.agrees else "yellow")
    common.print_table(args, table)


def _figures(merit: Merit) -> tuple[str, str, str]:
    return f"{1e3 * merit.u_P_newtons:.2f}", f"{merit.u_phi_deg:.4f}", f"{merit.u_theta_deg:.4f}"


def _sentences(args: argparse.Namespace, outcome: Outcome) -> list[str]:
    best, first, least = outcome.best, outcome.paper[0], outcome.condition_only
    lines = [
        f"{best.name}: u(theta) {_change(best, reference)} against case {reference.name}, condition number "
        f"{best.theory.condition_number:.3f} against {reference.theory.condition_number:.3f}"
        for reference in outcome.paper
        if reference.name in ("I", "I glued")
    ]
    lines.append(
        f"condition number alone: {least.theory.condition_number:.3f}, but u(theta) "
        f"{_ratio(least, first, 'u_theta_deg'):.2f} times and sqrt(trace(C C^T)) "
        f"{_ratio(least, first, 'noise_gain_newtons'):.2f} times those of case I"
    )
    verdict = "PASS" if best.agrees else "FAIL"
    lines.append(
        f"beam theory and the independent frame agree within {100 * AGREEMENT:.0f} %: {verdict} "
        f"({', '.join(f'{entry.name} {100 * entry.disagreement:.2f} %' for entry in dict.fromkeys((best, least)))})"
    )
    if args.gauges > 3:
        lines.append("cases I to III have 3 gauges: a part of the gain is that of more gauges")
        for entry in outcome.front:
            faults = ", ".join(f"SG{k + 1} {size:.3g}" for k, size in enumerate(_detectable(entry, args.noise)))
            lines.append(
                f"{entry.name}: smallest fault that a sample shows, microstrain: {faults or 'no noise stated'}"
            )
    return lines


def _detectable(entry: Assessment, noise_microstrain: float) -> list[float]:
    """The smallest fault of each gauge that a sample shows, microstrain, with C known; none for three gauges."""
    if len(entry.gauges) < 4 or not noise_microstrain > 0.0:
        return []
    A, Sigma = gauge_matrix(entry.geometry, entry.gauges), np.eye(len(entry.gauges)) * noise_microstrain**2 * 1e-12
    detectable: list[float] = (
        1e6 * detectable_strain(parity(weighted_inverse(A, Sigma), Sigma), FALSE_ALARM_RATE)
    ).tolist()
    return detectable


def _record(entry: Assessment) -> dict[str, object]:
    record: dict[str, object] = {"name": entry.name}
    record |= asdict(entry.geometry)
    record["gauges"] = [gauge_name(gauge) for gauge in entry.gauges]
    for prefix, merit in (("", entry.theory), ("frame_", entry.frame), ("finite_joint_", entry.frame_finite_joint)):
        record |= {f"{prefix}{field.name}": getattr(merit, field.name) for field in fields(Merit)}
    for name in ("worst_stress_pascals", "worst_strain", "slit_load_newtons", "disagreement", "agrees"):
        record[name] = getattr(entry, name)
    return record


def _summary(args: argparse.Namespace, outcome: Outcome) -> dict[str, object]:
    best, first, least = outcome.best, outcome.paper[0], outcome.condition_only
    return {
        "summary": True,
        "objective": args.objective,
        "best": best.name,
        "condition_number": best.theory.condition_number,
        "noise_microstrain": args.noise,
        "load_newtons": args.load,
        "u_theta_against_case_I": _ratio(best, first, "u_theta_deg"),
        "u_theta_against_case_I_glued": _ratio(best, outcome.paper[3], "u_theta_deg") if outcome.paper[3:] else None,
        "condition_only_u_theta_against_case_I": _ratio(least, first, "u_theta_deg"),
        "condition_only_noise_against_case_I": _ratio(least, first, "noise_gain_newtons"),
        "agreement_limit": AGREEMENT,
        "agrees": best.agrees,
        "seed": args.seed,
    }


def _ratio(entry: Assessment, reference: Assessment, figure: str) -> float:
    below = float(getattr(reference.theory, figure))
    return float(getattr(entry.theory, figure)) / below if below else float("nan")


def _change(entry: Assessment, reference: Assessment) -> str:
    return f"{100 * (_ratio(entry, reference, 'u_theta_deg') - 1):+.1f} %"
