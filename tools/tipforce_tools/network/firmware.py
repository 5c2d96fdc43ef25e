"""`tipforce firmware IDS [FILE]`: install a program on nodes with program slots, or show which one they run."""

from __future__ import annotations

import argparse

from tipforce_tools.cli import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce firmware`."""
    parser.epilog = (
        "Without FILE the command shows the version of each node, and why its last update failed.\n"
        "With FILE it installs the image on one node after the other. The node enters pre-operational and receives\n"
        "the image in blocks with CRC into the slot that does not run. It checks product, CRC-32 and signature, and\n"
        "restarts with the image. After five seconds of communication it confirms the program. Otherwise, and after a\n"
        "power cut at any time before, it runs the previous program. `tipforce nmt start` starts measurement again.\n\n"
        "An image for another product, with a wrong signature, or older than the installed program (without\n"
        "--allow-downgrade) is refused with exit code 12, as is every image by a node without program slots. The\n"
        "nodes after it are not touched. Exit code 2: the file is no image, or damaged; 5: a node does not respond.\n\n"
        "  tipforce firmware 1-5 -i socketcan -c can0\n"
        "  tipforce firmware 1-5 program.bin -i socketcan -c can0\n"
        "  tipforce firmware 5 older.bin --allow-downgrade --yes -i socketcan -c can0"
    )
    parser.add_argument("ids", type=common.node_ids, metavar="IDS", help="10, 0x0A or 1,2,5-9")
    parser.add_argument("file", nargs="?", metavar="FILE", help="program image; none: show the versions")
    parser.add_argument(
        "--allow-downgrade", action="store_true", help="install an image that is older than the program"
    )
    common.add_confirm_argument(parser)
    common.add_sdo_arguments(parser)
    parser.set_defaults(timeout=3.0)  # a node checks the complete image before it responds to the last block


def run(args: argparse.Namespace) -> int:
    """Show or install. Raises InputError for the file, RefusedError and NoResponseError of a node."""
    from tipforce.host.network.firmware import Firmware, install, node_program

    firmware = Firmware.read(args.file) if args.file else None
    with common.open_connection(args) as connection:
        if firmware is not None:
            nodes = ", ".join(map(common.shown_id, args.ids))
            common.confirm(args, f"node {nodes}: this replaces the program by {firmware.header.version_text()}")
        for node_id in args.ids:
            program = before = node_program(connection.sdo(node_id))
            if firmware is not None:
                with common.progress(
                    args, f"node {common.shown_id(node_id)}", len(firmware.content), absolute=True
                ) as arrived:
                    program = install(
                        connection, node_id, firmware, allow_downgrade=args.allow_downgrade, progress=arrived
                    )
            record = {
                "node_id": node_id, "version": program.version, "identification": f"0x{program.identification:08X}",
            } | ({} if firmware is None else {"version_before": before.version})  # fmt: skip
            change = program.version if firmware is None else f"{before.version} -> {program.version}"
            reason = f"  last update: {program.reason}" if program.reason else ""
            line = f"{common.shown_id(node_id):>11}  {change}  0x{program.identification:08X}{reason}"
            common.print_record(args, record | {"reason": program.reason}, line)
    return 0
