"""`tipforce design optimise`: search better dimensions and gauge positions, and verify them with a second model."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from tipforce.errors import InputError
from tipforce_tools.cli import common, tables

if TYPE_CHECKING:
    from tipforce_lab.design.merit import Assessment, Limits, Merit
    from tipforce_lab.design.search import Outcome

_LENGTHS = ("a", "d", "r", "h1", "h2", "width")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Envelope and stress default to the size of the paper's fabricated body and its maximum stress at the load;
    the paper states no minimum thickness or slenderness. Exit code 1 if beam theory and the frame differ by
    more than 3 % on the best design. The condition number does not fix the thickness; minimum noise does.
    `I glued`: case I with gauges of the stated length, which do not fit at the paper's points.
      tipforce design optimise --gauges 4 -o four.toml && tipforce node --node-id 5 --layout four.toml ...
    """
    parser.add_argument(
        "--objective", choices=("theta", "noise", "singular", "condition"), default="theta",
        help="minimise u(theta) (RMS over the loads), sqrt(trace(C C^T)), 1 / smallest singular value, or the "
        "condition number (default %(default)s)",
    )  # fmt: skip
    parser.add_argument("--gauges", type=int, default=3, metavar="N", help="3 to 5 (default %(default)s)")
    parser.add_argument("--starts", type=int, default=8, metavar="K", help="per configuration (default %(default)s)")
    parser.add_argument("--seed", type=common.whole_number, default=0, help="of the starts (default %(default)s)")
    parser.add_argument("-o", "--output", metavar="LAYOUT.toml", help="write the best design as a layout file")
    common.add_number(parser, "--noise", 0.5, "UE", "per gauge, microstrain (%(default)s)", common.above_0)
    common.add_number(parser, "--load", 4.4, "N", "of every push (default %(default)s)", float)
    group = parser.add_argument_group("limits")
    group.add_argument("--envelope", default="30,30.2", metavar="X,Y", help="mm: 2 r by d + h1/2 + r (%(default)s)")
    common.add_number(group, "--width", 10.0, "MM", "of the beams (default %(default)s)", float)
    common.add_number(group, "--min-h", 0.2, "MM", "least thickness (default %(default)s)", float)
    common.add_number(group, "--gauge-length", 1.0, "MM", "default %(default)s", float)
    common.add_number(group, "--slit", 0.25, "MM", "must stay open (default %(default)s)", float)
    common.add_number(group, "--max-stress", None, "MPA", "at the load, worst angle (default: the paper's)", float)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Search, print, write; return 0, or 1 if the frame does not confirm the best design."""
    from tipforce.output_file import LAYOUT, check_output
    from tipforce.sources.layout_file import write_layout
    from tipforce_lab.design.merit import record
    from tipforce_lab.design.search import optimise, steps

    if args.output:
        check_output(args.output, LAYOUT)
    limits = _limits(args)
    with common.progress("starts", steps(args.gauges, args.starts)) as done:
        outcome = optimise(
            args.objective, args.gauges, limits, args.noise, starts=args.starts, seed=args.seed, done=done
        )
    entries = [*outcome.paper, *outcome.front]
    if common.OUTPUT.json:
        for entry in entries:
            common.print_json(record(entry, args.noise))
        common.print_json(_summary(args, outcome))
    else:
        _print_tables(entries, args.noise, args.load)
        print("\n".join(_sentences(outcome, args.gauges, args.noise)))
    if args.output:
        best = outcome.best
        write_layout(args.output, best.geometry, best.gauges, args.gauge_length * 1e-3, _comment(args, best))
        common.note(f"wrote {args.output}")
    return 0 if outcome.best.agrees else 1


def _limits(args: argparse.Namespace) -> Limits:
    from tipforce_lab.design.merit import Limits

    try:
        x_mm, y_mm = (float(part) for part in args.envelope.split(","))
    except ValueError:
        raise InputError(f"--envelope {args.envelope!r}: expected two numbers separated by a comma") from None
    return Limits(
        envelope_x_m=x_mm * 1e-3,
        envelope_y_m=y_mm * 1e-3,
        width_m=args.width * 1e-3,
        min_thickness_m=args.min_h * 1e-3,
        gauge_length_m=args.gauge_length * 1e-3,
        slit_m=args.slit * 1e-3,
        load_newtons=args.load,
        max_stress_pascals=None if args.max_stress is None else args.max_stress * 1e6,
    )


def _comment(args: argparse.Namespace, best: Assessment) -> str:
    merit = best.theory
    return (
        f"tipforce design optimise --objective {args.objective} --gauges {args.gauges} --seed {args.seed}\n"
        f"At {args.noise:g} microstrain noise per gauge and {args.load:g} N, RMS over the pad and the friction cone:\n"
        f"u(P) {1e3 * merit.u_P_newtons:.3g} mN, u(phi) {merit.u_phi_deg:.3g} deg, u(theta) {merit.u_theta_deg:.3g} "
        f"deg; condition number {merit.condition_number:.3f}; worst stress {best.worst_stress_pascals * 1e-6:.0f} MPa"
    )


def _print_tables(entries: list[Assessment], noise_microstrain: float, load_newtons: float) -> None:
    from tipforce.sensor.structure.strain import gauge_name

    structures, figures, frames = [], [], []
    for entry in entries:
        lengths = (f"{1e3 * getattr(entry.geometry, f'{symbol}_m'):.3f}" for symbol in _LENGTHS)
        structures.append((entry.name, *lengths, ", ".join(map(gauge_name, entry.gauges))))
        merit, joint = entry.theory, entry.frame_finite_joint
        figures.append((
            entry.name, *_figures(merit), f"{1e3 * merit.noise_gain_newtons:.2f}",
            f"{merit.smallest_singular_value:.1f}", f"{merit.condition_number:.3f}",
            f"{entry.worst_stress_pascals * 1e-6:.0f}", f"{entry.slit_load_newtons:.1f}",
        ))  # fmt: skip
        frames.append((
            entry.name, *_figures(entry.frame), f"{entry.frame.condition_number:.3f}",
            f"{100 * entry.disagreement:.2f}", f"{joint.u_theta_deg:.4f}", f"{joint.condition_number:.3f}",
        ))  # fmt: skip
    doubts = [None if entry.agrees else "yellow" for entry in entries]
    u = ("", ">u(P) mN", ">u(phi) deg", ">u(theta) deg")
    title = "Structures, mm; gauges: beam, side, middle of the gauge from the joint"
    tables.print_rows(title, ("", *(f">{symbol}" for symbol in _LENGTHS), "SG1, SG2, ..."), structures)
    at = f"at {noise_microstrain:g} microstrain and {load_newtons:g} N"
    title = f"Standard uncertainties {at}, and limits of the body"
    tables.print_rows(title, (*u, ">mN per ue", ">least ue/N", ">cond", ">MPa", ">slit shuts N"), figures, doubts)
    title = "The same by the frame: shear and elastic roots; then with the joint a block h2 wide as well"
    tables.print_rows(title, (*u, ">cond", ">differs %", ">block: u(theta)", ">cond"), frames, doubts)


def _figures(merit: Merit) -> tuple[str, str, str]:
    return f"{1e3 * merit.u_P_newtons:.2f}", f"{merit.u_phi_deg:.4f}", f"{merit.u_theta_deg:.4f}"


def _sentences(outcome: Outcome, gauges: int, noise_microstrain: float) -> list[str]:
    from tipforce_lab.design.merit import AGREEMENT, detectable_microstrain

    best, first, least = outcome.best, outcome.paper[0], outcome.condition_only
    verdict = "PASS" if best.agrees else "FAIL"
    checked = ", ".join(f"{entry.name} {100 * entry.disagreement:.2f} %" for entry in dict.fromkeys((best, least)))
    lines = [
        *(
            f"{best.name}: u(theta) {100 * (_ratio(best, case, 'u_theta_deg') - 1):+.1f} % against case {case.name}, "
            f"condition number {best.theory.condition_number:.3f} against {case.theory.condition_number:.3f}"
            for case in outcome.paper
            if case.name in ("I", "I glued")
        ),
        f"condition number alone: {least.theory.condition_number:.3f}, but u(theta) "
        f"{_ratio(least, first, 'u_theta_deg'):.2f} times and sqrt(trace(C C^T)) "
        f"{_ratio(least, first, 'noise_gain_newtons'):.2f} times those of case I",
        f"beam theory and the independent frame agree within {100 * AGREEMENT:.0f} %: {verdict} ({checked})",
    ]
    if gauges > 3:
        lines.append("cases I to III have 3 gauges: a part of the gain is that of more gauges")
        for entry in outcome.front:
            sizes = detectable_microstrain(entry, noise_microstrain)
            faults = ", ".join(f"SG{k} {size:.3g}" for k, size in enumerate(sizes, 1))
            lines.append(
                f"{entry.name}: smallest fault that a sample shows, microstrain: {faults or 'no noise stated'}"
            )
    return lines


def _summary(args: argparse.Namespace, outcome: Outcome) -> dict[str, object]:
    from tipforce_lab.design.merit import AGREEMENT

    best, first, least = outcome.best, outcome.paper[0], outcome.condition_only
    return {
        "summary": True, "objective": args.objective, "best": best.name,
        "condition_number": best.theory.condition_number, "noise_microstrain": args.noise, "load_newtons": args.load,
        "u_theta_against_case_I": _ratio(best, first, "u_theta_deg"),
        "u_theta_against_case_I_glued": _ratio(best, outcome.paper[3], "u_theta_deg") if outcome.paper[3:] else None,
        "condition_only_u_theta_against_case_I": _ratio(least, first, "u_theta_deg"),
        "condition_only_noise_against_case_I": _ratio(least, first, "noise_gain_newtons"),
        "agreement_limit": AGREEMENT, "agrees": best.agrees, "seed": args.seed,
    }  # fmt: skip


def _ratio(entry: Assessment, reference: Assessment, figure: str) -> float:
    below = float(getattr(reference.theory, figure))
    return float(getattr(entry.theory, figure)) / below if below else float("nan")
