"""Arguments of `tipforce dataset DIR`."""

import argparse

from tipforce_tools.cli import common

DESCRIPTION = """\
Show what a dataset of `tipforce decode -o DIR/` holds, check it, compact it, or query it with SQL.
"""
EPILOG = """\
DIR: a directory, or a URL that fsspec opens. The views of --sql: samples (hand, date, node and all columns of the
rows), events (t_s, channel, node, event, code, text), parts and logs of the manifest. Only files that a query needs
are read. A query is one SELECT: without --unrestricted it opens no other file, and has 2 GiB of memory.
exit codes: 0 ok, 1 a file is missing or damaged, 2 usage

  tipforce dataset data/
  tipforce dataset data/ --verify
  tipforce dataset data/ --compact
  tipforce dataset data/ --sql "select node, max(P_N) from samples where date = '2026-05-17' group by node"
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce dataset` to `parser`."""
    parser.description = DESCRIPTION
    parser.epilog = EPILOG
    parser.add_argument("directory", metavar="DIR", help="of `tipforce decode -o DIR/`")
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--verify", action="store_true", help="compare the SHA-256 of each file")
    group.add_argument("--compact", action="store_true", help="join the files of a day; all get the same columns")
    group.add_argument("--sql", metavar="QUERY", help="query it with DuckDB")
    parser.add_argument(
        "--unrestricted", action="store_true", help="--sql: also other statements, files, the network, and all memory"
    )
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Show, check, compact or query. Raises InputError, EnvironmentLackError without DuckDB or pyarrow."""
    from tipforce.host.dataset.reader import opened

    if args.sql is not None:
        from tipforce_tools.dataset.sql import query

        return query(args, *opened(args.directory))
    from tipforce_tools.dataset import content

    store, manifest = opened(args.directory)
    if args.compact:
        from tipforce_tools.decode.dataset_files import compact

        files = len(manifest.files())
        manifest = compact(store)
        common.note(args, f"{store.name}: {files} files are {len(manifest.files())} now")
        return 0
    wrong = content.wrong_files(store, manifest, hashes=args.verify)
    if args.json:
        common.print_json(content.record(store, manifest, wrong))
    else:
        print("\n".join(content.lines(store, manifest, wrong)))
        if args.verify and not wrong:
            print(f"{len(manifest.files())} files are as they were written")
    return 1 if wrong else 0
