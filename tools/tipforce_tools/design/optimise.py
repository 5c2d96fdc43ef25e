"""`tipforce design optimise`: search better dimensions and gauge positions, and verify them with a second model."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from tipforce.errors import InputError
from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce_lab.design.merit import Assessment, LoadSet
    from tipforce_lab.design.search import Design, Limits, Objective

_FROM = 4  # configurations from which the path to the minimum condition number starts


class Outcome(NamedTuple):
    """Result of one run."""

    paper: list[Assessment]
    """Cases I to III of the paper, then case I with gauges of the stated length."""
    front: list[Assessment]
    """Pareto-optimal designs in objective and condition number, and always condition_only."""
    best: Assessment
    """The best design by the objective."""
    condition_only: Assessment
    """The design with the minimum condition number, and among such designs the minimum noise."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce design optimise`."""
    parser.epilog = (
        "Envelope and stress default to the size of the paper's fabricated body and its maximum stress at the load;\n"
        "the paper states no minimum thickness or slenderness. Exit code 1 if beam theory and the frame differ by\n"
        "more than 3 % on the best design. The condition number does not fix the thickness; minimum noise does.\n"
        "`I glued`: case I with gauges of the stated length, which do not fit at the paper's points.\n"
        "  tipforce design optimise --gauges 4 -o four.toml && tipforce node --node-id 5 --layout four.toml ..."
    )
    parser.add_argument(
        "--objective", choices=("theta", "noise", "singular", "condition"), default="theta",
        help="minimise u(theta) (RMS over the loads), sqrt(trace(C C^T)), 1 / smallest singular value, or the "
        "condition number (default %(default)s)",
    )  # fmt: skip
    parser.add_argument("--gauges", type=int, default=3, metavar="N", help="3 to 5 (default %(default)s)")
    parser.add_argument("--starts", type=int, default=8, metavar="K", help="per configuration (default %(default)s)")
    parser.add_argument("--seed", type=common.seed, default=0, help="of the starts (default %(default)s)")
    parser.add_argument("-o", "--output", metavar="LAYOUT.toml", help="write the best design as a layout file")
    _add_loads(parser)
    _add_limits(parser)
    common.add_output_arguments(parser)


def _add_loads(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("noise and loads")
    group.add_argument("--noise", type=float, default=0.5, metavar="UE", help="per gauge, microstrain (%(default)s)")
    group.add_argument("--load", type=float, default=4.4, metavar="N", help="of every push (default %(default)s)")
    group.add_argument("--pad", default="0,180", metavar="MIN,MAX", help="contacts theta, degrees (%(default)s)")
    group.add_argument("--friction", type=float, default=0.5, metavar="MU", help="half cone: atan MU (%(default)s)")


def _add_limits(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("limits")
    group.add_argument(
        "--envelope", default="30,30.2", metavar="X,Y", help="mm: 2 r across, d + h1/2 + r high (%(default)s)"
    )
    group.add_argument("--width", type=float, default=10.0, metavar="MM", help="of the beams (default %(default)s)")
    group.add_argument("--free-width", action="store_true", help="allow a smaller width, down to a tenth")
    group.add_argument("--radius", type=float, metavar="MM", help="of the tip (default: free, at most X / 2)")
    group.add_argument("--wall", type=float, default=0.0, metavar="MM", help="least r - a (default %(default)s)")
    group.add_argument(
        "--slender", type=float, default=10.0, metavar="X", help="least length over thickness (default %(default)s)"
    )
    group.add_argument("--min-h", type=float, default=0.2, metavar="MM", help="least thickness (default %(default)s)")
    group.add_argument("--gauge-length", type=float, default=1.0, metavar="MM", help="default %(default)s")
    group.add_argument(
        "--clearance", type=float, default=0.0, metavar="MM", help="of gauges to corners and each other (%(default)s)"
    )
    group.add_argument("--upper-face", action="store_true", help="also allow gauges in the slit")
    group.add_argument("--slit", type=float, default=0.25, metavar="MM", help="must stay open (default %(default)s)")
    stress = group.add_mutually_exclusive_group()
    stress.add_argument(
        "--max-stress", type=float, metavar="MPA", help="at the load, worst angle (default: the paper's)"
    )
    stress.add_argument("--yield", dest="yield_MPa", type=float, metavar="MPA", help="stress at most this / --safety")
    group.add_argument("--safety", type=float, default=1.5, metavar="S", help="for --yield (default %(default)s)")


def run(args: argparse.Namespace) -> int:
    """Search, print, write; return 0, or 1 if the frame does not confirm the best design."""
    from tipforce.output_file import LAYOUT, check_output
    from tipforce_tools.cli.layout_file import write_layout
    from tipforce_tools.design.optimise_output import comment, print_outcome

    common.set_up_logging(args)
    if args.output:
        check_output(args.output, LAYOUT)
    if not 0.0 <= args.noise < math.inf:
        raise InputError(f"--noise {args.noise}: allowed is 0 or more")
    outcome = optimise(args, *_limits_and_loads(args))
    print_outcome(args, outcome)
    if args.output:
        best = outcome.best
        write_layout(args.output, best.geometry, best.gauges, args.gauge_length * 1e-3, comment(args, best))
        common.note(args, f"wrote {args.output}")
    return 0 if outcome.best.agrees else 1


def optimise(args: argparse.Namespace, limits: Limits, loads: LoadSet) -> Outcome:
    """Optimise the objective and the condition number, follow the path between them, and assess all designs."""
    from tipforce_lab.design.merit import FIGURES, pareto
    from tipforce_lab.design.search import TRADE_OFF_STEPS, configurations, search, trade_off

    axis: Objective = "theta" if args.objective == "condition" else args.objective
    starts = len(configurations(args.gauges, limits.upper_face)) * max(args.starts, 0)
    with common.progress(args, "starts", 2 * starts + (_FROM + 1) * len(TRADE_OFF_STEPS)) as done:
        best = search(args.gauges, axis, limits, loads, starts=args.starts, seed=args.seed, done=done)
        least = search(args.gauges, "condition", limits, loads, starts=args.starts, seed=args.seed, done=done)[0]
        between = trade_off(best[0], best[1:_FROM], least, axis, loads, limits, done)
    judged = _Judge(args, limits, loads)
    first, condition_only = judged.design(best[0], "best"), judged.design(least, "condition")
    others = [judged.design(design, "") for design in (*best[1:], *between)]
    front = pareto([first, *others, condition_only], (FIGURES[axis], FIGURES["condition"]))
    front = [entry if entry.name else replace(entry, name=f"{k}") for k, entry in enumerate(front, 1)]
    if condition_only not in front:
        front.append(condition_only)
    return Outcome(judged.paper(), front, condition_only if args.objective == "condition" else first, condition_only)


class _Judge:
    """Call assess() with the values of the flags."""

    def __init__(self, args: argparse.Namespace, limits: Limits, loads: LoadSet) -> None:
        self.limits = limits
        self.options = {
            "loads": loads, "noise_microstrain": args.noise,
            "gauge_length_m": limits.gauge_length_m, "slit_m": limits.slit_m,
        }  # fmt: skip

    def paper(self) -> list[Assessment]:
        from tipforce.sensor.structure.geometry import FABRICATED
        from tipforce.sensor.structure.layouts import CASES, LAYOUTS
        from tipforce_lab.design.merit import assess, glued

        assessments = [assess(case, FABRICATED, LAYOUTS[case], **self.options) for case in CASES]
        try:
            real = glued(FABRICATED, LAYOUTS["I"], self.limits.gauge_length_m, self.limits.clearance_m)
            return [*assessments, assess("I glued", FABRICATED, real, **self.options)]
        except InputError:  # gauges of this length do not fit on the paper's body
            return assessments

    def design(self, design: Design, name: str) -> Assessment:
        from tipforce_lab.design.merit import assess

        return assess(name, design.geometry, design.gauges, **self.options)


def _limits_and_loads(args: argparse.Namespace) -> tuple[Limits, LoadSet]:
    from tipforce_lab.design.merit import LoadSet
    from tipforce_lab.design.search import Limits

    envelope = _pair("--envelope", args.envelope)
    loads = LoadSet(args.load, *_pair("--pad", args.pad), args.friction)
    max_stress = args.max_stress
    if args.yield_MPa is not None:
        if not args.safety > 0.0:
            raise InputError(f"--safety {args.safety}: allowed is above 0")
        max_stress = args.yield_MPa / args.safety
    limits = Limits(
        envelope_x_m=envelope[0] * 1e-3,
        envelope_y_m=envelope[1] * 1e-3,
        width_m=args.width * 1e-3,
        free_width=args.free_width,
        radius_m=None if args.radius is None else args.radius * 1e-3,
        min_thickness_m=args.min_h * 1e-3,
        slenderness=args.slender,
        wall_m=args.wall * 1e-3,
        gauge_length_m=args.gauge_length * 1e-3,
        clearance_m=args.clearance * 1e-3,
        slit_m=args.slit * 1e-3,
        load_newtons=args.load,
        max_stress_pascals=None if max_stress is None else max_stress * 1e6,
        upper_face=args.upper_face,
    )
    return limits, loads


def _pair(flag: str, text: str) -> tuple[float, float]:
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"{flag} {text!r}: expected two numbers separated by a comma") from None
    return first, second
