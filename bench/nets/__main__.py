"""Whether a change of the layout changed anything that a user sees, or what it costs.

    python -m bench.nets make                    files of a user and golden outputs of the reference, under build/nets
    python -m bench.nets check                   the working tree against the reference, byte for byte
    python -m bench.nets check --only 'log-*'    some cases
    python -m bench.nets costs                   ratios against the baselines, interleaved

``--reference`` is the commit whose outputs are right, ``--files`` the one whose commands made the files of a
user. Their trees are under build/nets/trees. Differences that are right are entered in accepted.toml, each with its
reason. adapter.py is the one file with internal names of the product. compare.py leaves out what no two runs have in
common (times).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.nets.compare import check, inputs, run_cases
from bench.nets.trees import ROOT, Tree

REFERENCE, FILES = "c80f866", "9931bb3"
DECODE_BASELINE, COLLECTOR_BASELINE = "e2c4c76", "9931bb3"


def main() -> int:
    """Run as a command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mode", choices=("make", "check", "costs"))
    parser.add_argument("--reference", default=REFERENCE, metavar="REF")
    parser.add_argument("--files", default=FILES, metavar="REF")
    parser.add_argument("--only", default="*", metavar="PATTERN", help="cases (log-*,help), or figures of costs")
    parser.add_argument("--tree", type=Path, default=ROOT, help="another checkout than this one is checked")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--pairs", type=int, default=7, help="of each figure of costs")
    parser.add_argument("--quick", action="store_true", help="costs without 10 M frames")
    parser.add_argument(
        "--baseline",
        metavar="REF",
        help=f"of costs (default {DECODE_BASELINE}; collector, read_log {COLLECTOR_BASELINE})",
    )
    args = parser.parse_args()
    if args.mode == "costs":
        from bench.nets.costs import costs

        return costs(
            args.baseline or DECODE_BASELINE, args.baseline or COLLECTOR_BASELINE, args.only, args.pairs, args.quick
        )
    given = inputs(args.files)
    before = run_cases(Tree.of(args.reference), given, args.jobs, args.only, False)
    if args.mode == "make":
        return 0
    tree = Tree(args.tree.resolve().name, args.tree.resolve())
    after = run_cases(tree, given, args.jobs, args.only, True)

    def retry(name: str) -> None:
        run_cases(tree, given, 1, name, True)

    return 1 if check(before, after, args.only, retry) else 0


if __name__ == "__main__":
    raise SystemExit(main())
