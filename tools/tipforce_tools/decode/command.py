"""Arguments of `tipforce decode [LOG ...|-] [-o FILE]`."""

import argparse

from tipforce_tools.cli import common
from tipforce_tools.cli.eds_flag import add_eds_argument

DESCRIPTION = """\
Convert logs to contact: one row per sample of each node, the PDOs of a sample joined by its counter. Several logs
form one recording, in the order given. Values unknown on the wire are missing in the output: empty cell, null, NaN.
"""
EPILOG = """\
LOG: candump's text (-L, -l, or the screen's with -t; .gz and .zst too), .asc .blf .csv .db .mf4 .trc, pcap, pcapng.
Columns: t_s (receive time, seconds of the epoch; a UTC timestamp in Parquet), channel (when there are several), node,
counter (unwrapped), P_N, phi_deg, theta_deg, F1_N.., SG1_ue.. (microstrain), status flags; those in the log.
--resample takes the mean over each interval, for phi and theta of their directions; `n_P_N` is the number of samples.
Lost samples (gaps in the counter) and bad lines are reported on stderr; with --json and -o, as a summary on stdout.
A packed log may unpack to 200 times its bytes, or 256 MiB; a log may have 256 interfaces.
exit codes: 0 ok, 1 a bad line with --strict, a full disk, a damaged log or one of other devices, frames left out of
more than 256 interfaces, 2 usage

  tipforce decode run.log                                    text
  tipforce decode run.log -o run.csv
  tipforce decode run.log.gz --signals P,theta --nodes 1,2,5-9 --from 10 --to 12.5 -o part.csv
  tipforce decode 'logs/*.log' -o data/ --json                a dataset of Parquet files that grows; a summary
  tipforce decode run.log --summary
  tipforce decode run.log --resample 50 -o slow.parquet
  tipforce decode run.log --calibration 5=thumb.toml --signals P,phi,theta,u_P,u_phi,u_theta -o contact.csv
  candump -L can0 | tipforce decode - --format jsonl | jq .P_N
  tipforce decode run.log --follow -o data/                  fill it while the log is recorded
  tipforce decode 'logs/*.log' --scheduler tcp://10.0.0.1:8786 -o data/
  tipforce dataset sql data/ "select node, max(P_N) from samples group by node"
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce decode` to `parser`."""
    parser.description = DESCRIPTION
    parser.epilog = EPILOG
    parser.add_argument(
        "logs", nargs="*", type=common.LogFile(), metavar="LOG", help="files and globs; default or -: stdin"
    )
    parser.add_argument("-o", "--output", metavar="FILE", help=".csv .jsonl .parquet .mcap, or DIR/, a dataset")
    parser.add_argument("--format", choices=("text", "csv", "jsonl", "parquet", "mcap"), help="default: by the suffix")
    parser.add_argument("--summary", action="store_true", help="print the contents per node; no rows without -o")
    parser.add_argument("--strict", action="store_true", help="exit with 1 at the first bad line")
    parser.add_argument("--follow", action="store_true", help="wait for more lines at the end of the log")
    parser.add_argument("--deltas", action="store_true", help="timestamps are differences (candump -td)")
    parser.add_argument("--hand", metavar="NAME", help="partition of DIR/ (default: the name of the interface)")
    group = parser.add_argument_group("choice")
    add_choice(group, "compute only these, for example P,theta or P_N,theta_deg")
    group.add_argument("--resample", type=float, metavar="HZ", help="means on a uniform grid")
    group = parser.add_argument_group("layouts (default: the dictionary's PDOs)")
    add_layouts(group)
    group.add_argument("--ask", type=common.node_ids, metavar="IDS", help="read the layout of these nodes over SDO")
    group.add_argument("-i", "--interface", help="for --ask: python-can's interface")
    group.add_argument("-c", "--channel", help="of --ask")
    group.add_argument("-b", "--bitrate", type=int, help="of --ask")
    group = parser.add_argument_group("work")
    group.add_argument(
        "-j",
        "--jobs",
        type=common.count,
        metavar="N",
        help="processes that decode and write parts of the logs (default: one; above 1 GB one per core)",
    )
    group.add_argument("--scheduler", metavar="ADDRESS", help="decode on a Dask cluster that can read the files")
    common.add_output_arguments(parser)


def add_choice(group: argparse._ArgumentGroup, signals: str) -> None:
    """Add the flags that choose rows and columns of logs; ``signals`` is the help of --signals."""
    group.add_argument("--signals", metavar="NAMES", help=signals)
    group.add_argument("--nodes", type=common.node_ids, metavar="IDS", help="as 1,2,5-9")
    group.add_argument("--bus", metavar="NAMES", help="only frames of these interfaces of the log: can0,can1")
    group.add_argument("--from", dest="start", metavar="TIME", help="seconds from the start or of the epoch, ISO time")
    group.add_argument("--to", dest="end", metavar="TIME", help="end, exclusive; same formats")
    group.add_argument(
        "--calibration", action="append", metavar="[NODE=]CAL.toml", help="compute contact from the gauges; repeatable"
    )


def add_layouts(group: argparse._ArgumentGroup) -> None:
    """Add the flags of the PDOs that nodes send."""
    group.add_argument("--gauges", type=int, choices=range(3, 9), metavar="N", help="3 (default) to 8")
    group.add_argument("--dcf", action="append", metavar="FILE", help="configuration of a node; repeatable")
    group.add_argument("--dbc", metavar="FILE", help="use the messages of a DBC instead; tipforce: the shipped one")
    add_eds_argument(group)


def run(args: argparse.Namespace) -> int:
    """Decode; return 0, or 1 for a bad line with --strict.

    Raises InputError for unusable input, EnvironmentLackError for a missing package or a node that does not respond.
    """
    from tipforce_tools.cli.main import terminate_as_interrupt
    from tipforce_tools.decode.session import decode

    terminate_as_interrupt()
    return decode(args)
