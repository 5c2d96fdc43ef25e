"""`tipforce tare IDS`: take the force that a node reads now as zero, show what is taken off, or end it."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce.host.network.finger import Tare


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of `tipforce tare`."""
    parser.epilog = (
        "Tare with nothing touching the fingertip: a tare under load hides that load. It is not stored, and ends with\n"
        "a reset or a new calibration. A node without a calibration refuses (exit code 11).\n"
        "  tipforce tare 1-5 -i socketcan -c can0\n"
        "  tipforce tare 1-5 --show -i socketcan -c can0"
    )
    parser.add_argument("ids", type=common.node_ids, metavar="IDS", help="10, 0x0A or 1,2,5-9")
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--clear", action="store_true", help="end the tare")
    group.add_argument("--show", action="store_true", help="change nothing")
    common.add_sdo_arguments(parser)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Act on each node and print what it takes off afterwards. Raises NoResponseError and SdoAbortError."""
    from tipforce.host.network.finger import FingertipClient

    common.set_up_logging(args)
    with common.open_connection(args) as connection:
        for node_id in args.ids:
            client = FingertipClient(connection.sdo(node_id))
            if args.clear:
                client.clear_tare()
            elif not args.show:
                client.tare()
            _say(args, node_id, client.tare_state())
    return 0


def _say(args: argparse.Namespace, node_id: int, tare: Tare) -> None:
    if args.json:
        f1, f2, f3 = tare.force_newtons
        common.print_json({"node_id": node_id, "F1_N": f1, "F2_N": f2, "F3_N": f3, "age_s": tare.age_s})
        return
    forces = ", ".join(f"F{k + 1} {value:+.4f} N" for k, value in enumerate(tare.force_newtons))
    since = f"since {tare.age_s} s" if any(tare.force_newtons) else "no tare"
    print(f"{common.shown_id(node_id):>11}  {forces}  {since}")
