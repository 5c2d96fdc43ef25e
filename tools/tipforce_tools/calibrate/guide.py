"""`tipforce calibrate guide`: guided calibration of a node on the bus, from the first weight to storage."""

import argparse

from tipforce.errors import InputError
from tipforce.output_file import CALIBRATION, check_output
from tipforce_tools.calibrate import fit
from tipforce_tools.cli import bus_flags, common

DEFAULT_WEIGHTS = "4.4"
AUTO_SCATTER_DEG, HAND_SCATTER_DEG = 0.0, 0.5  # a simulated load has its nominal direction


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """At each step: Enter captures, s skips, r repeats the last step, q saves and quits. Each capture is one row
    of the session file, written to disk at once: the same command continues where it stopped. At the end the
    calibration is fitted, shown, and after confirmation written to the node, verified and stored.
      tipforce calibrate guide --node 5 --weights 4.4,2.2 --session a.csv -o finger.toml -i socketcan -c can0
      tipforce calibrate guide --node 5 --auto -o finger.toml -i socketcan -c vcan0      (a simulated node)
    A plan for another rig (TOML): a [[step]] per load with P_N, phi_deg, theta_deg, optional mode (pull, push,
    tare) and instruction; tare_every = 4 sets the number of loads between unloaded readings.
    """
    parser.add_argument("--node", "--node-id", type=common.node_id, required=True, metavar="ID", help="1 to 127")
    parser.add_argument("--plan", metavar="PLAN.toml", help="steps for another rig")
    parser.add_argument("--weights", metavar="N,N", help=f"weights in newtons (default {DEFAULT_WEIGHTS})")
    parser.add_argument("--grooves", metavar="paper|x30,y60,...", help="default: paper, its 19 grooves")
    parser.add_argument("--session", metavar="FILE.csv", help="default: session-SERIAL.csv, serial of the node")
    parser.add_argument("-o", "--output", metavar="CAL.toml", help="calibration file to write")
    parser.add_argument("--auto", action="store_true", help="simulated node: apply the loads itself")
    group = parser.add_argument_group("capture")
    count = common.number_that(lambda value: 10 <= value <= 100_000, "is 10 to 100000", int)
    group.add_argument("--samples", type=count, default=200, metavar="N", help="of a capture (default %(default)s)")
    period = common.number_within(0.0, 1000.0, "is above 0, up to 1000", over=True)
    limit = common.number_within(0.0, 1e6, "is above 0, up to 1e+06", over=True)
    common.add_number(group, "--period", 5.0, "MS", "between samples (default %(default)s)", period)
    common.add_number(group, "--max-std", 5.0, "UE", "largest scatter, microstrain (default %(default)s)", limit)
    common.add_number(group, "--max-drift", 2.0, "UE", "largest drift, microstrain (default %(default)s)", limit)
    parser.add_argument("--layout", metavar="I|II|III|FILE", help="gauge layout, for file and prior")
    fit.add_model_arguments(parser, None, "0.5; --auto: 0")
    bus_flags.add_bus_arguments(parser, sdo=True, confirm=True)


def run(args: argparse.Namespace) -> int:
    """Execute the plan; return 0 if it is done or the user quits, 1 if a capture of --auto was refused."""
    if args.plan:
        for flag in ("weights", "grooves"):
            if getattr(args, flag) is not None:
                raise InputError(f"--plan and --{flag}: allowed is one of them; the plan defines the loads")
        common.InputFile("plan ").check(args.plan)
    from tipforce.host.configuration.guide import file_plan, groove_plan
    from tipforce_tools.calibrate.guide_walk import Walk

    steps = file_plan(args.plan) if args.plan else groove_plan(args.weights or DEFAULT_WEIGHTS, args.grooves or "paper")
    if args.output:  # before an hour of weights
        check_output(args.output, CALIBRATION)
    if args.angle_scatter is None:
        args.angle_scatter = AUTO_SCATTER_DEG if args.auto else HAND_SCATTER_DEG
    with bus_flags.open_connection(args) as connection:
        return Walk(args, steps, connection).run()
