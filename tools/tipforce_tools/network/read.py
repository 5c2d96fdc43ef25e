"""`tipforce read IDS`: the contact of fingers, with its uncertainty; a SYNC is sent where no other node sends one."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce.host.decoding.contacts import Contact

_VALUES = ("P_newtons", "phi_deg", "theta_deg", "u_P_newtons", "u_phi_deg", "u_theta_deg")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of `tipforce read`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = (
        "A finger that is pre-operational is started. An unknown value prints as nan (JSON: null), with its reason.\n"
        "  tipforce read 5 -i socketcan -c can0\n"
        "  tipforce read 1-5 -n 100 --json -i socketcan -c can0 | jq .P_newtons"
    )
    parser.add_argument("ids", type=common.node_ids, metavar="IDS", help="10, 0x0A or 1,2,5-9")
    parser.add_argument("-n", "--count", type=common.count, default=1, metavar="N", help="samples of each (default 1)")
    parser.add_argument("--wait", type=float, default=5.0, metavar="S", help="for each sample (default %(default)g s)")
    common.add_sdo_arguments(parser)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print ``count`` new samples of each finger: 0. Raises NoResponseError for a finger that gives none in time."""
    from tipforce.errors import InputError

    common.set_up_logging(args)
    if not 0.0 < args.wait < math.inf:
        raise InputError(f"--wait {args.wait:g}: allowed is a time over 0 s")
    with common.open_connection(args) as connection:
        for _ in range(args.count):
            for node_id in args.ids:
                _print(args, connection.finger(node_id).read(args.wait))
    return 0


def _print(args: argparse.Namespace, contact: Contact) -> None:
    if not args.json:
        u = f"u(P) {contact.u_P_newtons:.3f} N"
        print(f"{common.shown_id(contact.node_id):>11}  {contact}  {u}", flush=True)
        return
    values = {name: getattr(contact, name) for name in _VALUES}
    known = {name: value if math.isfinite(value) else None for name, value in values.items()}
    common.print_json(
        {"node_id": contact.node_id, "t_s": contact.t_s, "counter": contact.counter, **known,
         "status": int(contact.status), "reason": contact.reason, "microstrain": list(contact.microstrain)}
    )  # fmt: skip
