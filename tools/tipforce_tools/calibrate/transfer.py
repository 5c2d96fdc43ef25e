"""`tipforce calibrate apply|verify`: write a calibration file to a node, and compare them."""

from __future__ import annotations

import argparse

from tipforce_tools.cli import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of apply and verify."""
    parser.epilog = (
        "apply writes the record, which the node checks by CRC-32, commits it, reads it back, compares it byte for\n"
        "byte, and stores it. If the node refuses (exit code 12), the previous calibration stays active.\n"
        "verify exits with 1 if the node's active calibration differs from the file, and names each difference.\n"
        "  tipforce calibrate apply finger.toml --node 5 -i socketcan -c can0"
    )
    parser.add_argument("file", metavar="CAL.toml")
    parser.add_argument("--node", "--node-id", type=common.node_id, required=True, metavar="ID", help="1 to 127")
    parser.add_argument("--no-store", action="store_true", help="apply only until the next reset")
    common.add_confirm_argument(parser)
    common.add_sdo_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Apply (return 0; raises RefusedError) or verify (return 0 if equal, 1 if different)."""
    from tipforce.host.configuration.calibration_file import read_calibration
    from tipforce.host.network.finger import FingertipClient

    calibration = read_calibration(args.file)
    name = f"node {common.shown_id(args.node)}"
    if args.action == "apply" and not args.no_store:
        common.confirm(args, f"{name}: this replaces its stored calibration")
    with common.open_connection(args) as connection:
        client = FingertipClient(connection.sdo(args.node))
        if args.action == "apply":
            generation = client.apply_calibration(
                calibration, not args.no_store, lambda step: common.note(args, f"{name}: {step}")
            )
            crc32 = f"0x{calibration.crc32():08X}"
            record = {"node": args.node, "generation": generation, "crc32": crc32}
            common.print_record(args, record, f"applied, generation {generation}, CRC-32 {crc32}")
            return 0
        differences = client.verify_calibration(calibration)
    compared = {"node": args.node, "equal": not differences, "differences": differences}
    common.print_record(args, compared, "\n".join(differences) or "equal byte for byte")
    return 1 if differences else 0
