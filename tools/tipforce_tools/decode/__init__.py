"""Arguments of `tipforce decode [LOG ...|-] [-o FILE]`."""

import argparse
import gc

from tipforce_tools.cli import common, log_flags
from tipforce_tools.cli.bus_flags import add_bus_name_arguments

DESCRIPTION = """\
Convert logs to contact: one row per sample of each node, the PDOs of a sample joined by its counter. Several logs
form one recording, in the order given. Values unknown on the wire are missing in the output: empty cell, null, NaN.
"""
EPILOG = """\
LOG: candump's text (-L, -l, or the screen's with -t; .gz and .zst too), .asc .blf .csv .db .mf4 .trc, pcap, pcapng.
Columns: t_s (receive time, seconds of the epoch), channel (of several), node, counter (unwrapped), P_N, phi_deg,
theta_deg, F1_N.., SG1_ue.., status flags; those in the log. Lost samples and bad lines are reported on stderr.
Ctrl-C completes the output of stdin and of --follow.
exit codes: 1 a bad line with --strict, a damaged log or one of other devices, frames of more than 256 interfaces

  tipforce decode run.log.gz --signals P,theta --nodes 1,2,5-9 --from 10 --to 12.5 -o part.csv
  tipforce decode 'logs/*.log' -o data/ --json             a dataset of Parquet files that grows
  candump -L can0 | tipforce decode - --format jsonl | jq .P_N
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce decode` to `parser`."""
    parser.description = DESCRIPTION
    parser.epilog = EPILOG
    parser.add_argument("logs", nargs="*", type=common.LOG, metavar="LOG", help="files and globs; default or -: stdin")
    parser.add_argument("-o", "--output", metavar="FILE", help=".csv .jsonl .parquet .mcap, or DIR/, a dataset")
    parser.add_argument("--format", choices=("text", "csv", "jsonl", "parquet", "mcap"), help="default: by the suffix")
    parser.add_argument("--summary", action="store_true", help="print the contents per node; no rows without -o")
    parser.add_argument("--strict", action="store_true", help="exit with 1 at the first bad line")
    parser.add_argument("--follow", action="store_true", help="wait for more lines at the end of the log, until Ctrl-C")
    parser.add_argument("--deltas", action="store_true", help="timestamps are differences (candump -td)")
    parser.add_argument("--hand", metavar="NAME", help="partition of DIR/ (default: the interface)")
    parser.add_argument("--resample", type=float, metavar="HZ", help="means on a uniform grid, of angles by direction")
    parser.add_argument("-j", "--jobs", type=common.count, metavar="N", help="processes (above 1 GB all cores)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="decode on a Dask cluster that can read the files")
    log_flags.add_choice_arguments(parser, "compute only these: P,theta or P_N,theta_deg")
    parser.add_argument("--ask", type=common.node_ids, metavar="IDS", help="read their layouts by SDO, with -i -c")
    add_bus_name_arguments(parser)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Decode; return 0, or 1 for a bad line with --strict. Raises InputError for unusable input, EnvironmentLackError
    for a missing package or a node that does not respond."""
    collects = gc.isenabled()
    gc.disable()  # to look for garbage among what the imports make takes a tenth of the start
    try:
        from tipforce_tools.decode.session import decode

        gc.freeze()  # nor again and again while decoding
    finally:
        if collects:
            gc.enable()
    try:
        return decode(args)
    finally:
        gc.unfreeze()
