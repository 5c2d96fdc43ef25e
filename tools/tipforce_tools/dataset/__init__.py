"""`tipforce dataset show|verify|compact DIR`: what it holds, and which files are not as its manifest says."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Any

from tipforce.host.dataset.store import FOLDER, Store
from tipforce_tools.cli import common
from tipforce_tools.cli.common import shown_id
from tipforce_tools.cli.listening import counted

if TYPE_CHECKING:
    from tipforce.host.dataset.manifest import Manifest


def add_show_arguments(parser: argparse.ArgumentParser) -> None:
    """DIR: a directory, or a URL that fsspec opens. Exit code 1: a file is missing or damaged."""
    parser.add_argument("directory", metavar="DIR", help="of `tipforce decode -o DIR/`")
    common.add_output_arguments(parser)


add_verify_arguments = add_compact_arguments = add_show_arguments


def run_show(args: argparse.Namespace, *, hashes: bool = False) -> int:
    """Print the content: 0, or 1 if a file is missing or has another size, with ``hashes`` also another content."""
    from tipforce.host.dataset.reader import opened, wrong_files

    store, manifest = opened(args.directory)
    wrong = wrong_files(store, manifest, hashes=hashes)
    if args.json:
        common.print_json(record(store, manifest, wrong))
    else:
        print("\n".join(lines(store, manifest, wrong)))
        if hashes and not wrong:
            print(f"{len(manifest.files())} files are as they were written")
    return 1 if wrong else 0


def run_verify(args: argparse.Namespace) -> int:
    """Compare the hash of each file."""
    return run_show(args, hashes=True)


def run_compact(args: argparse.Namespace) -> int:
    """Join the files of a day: 0. Raises InputError, EnvironmentLackError without pyarrow."""
    from tipforce.host.dataset.reader import opened
    from tipforce_tools.writing.dataset_files import compact

    store, manifest = opened(args.directory)
    files = len(manifest.files())
    common.note(f"{store.name}: {files} files are {len(compact(store).files())} now")
    return 0


def record(store: Store, manifest: Manifest, wrong: dict[str, str]) -> dict[str, Any]:
    """Return the content as a JSON record."""
    from tipforce.host.dataset.reader import tally

    lost = tally(manifest).lost()
    return {
        "dataset": store.name,
        "generation": manifest.generation,
        "rows": sum(part.rows for part in manifest.parts),
        "files": len(manifest.files()),
        "bytes": sum(file.bytes for file in manifest.files()),
        "lost": sum(lost.values()),
        "nodes": [
            {"hand": hand, "node": node, "rows": rows, "days": days, "first_s": first / 1e9, "last_s": last / 1e9}
            for (hand, node), (rows, days, first, last) in sorted(_nodes(manifest).items())
        ],
        "calibrations": [
            {"channel": channel, "node": node, "crc": crc, "from_s": t_ns / 1e9}
            for (channel, node), told in _calibrations(manifest)
            for t_ns, crc in told
        ],
        "logs": [
            {
                "name": one.name,
                "bytes": one.size,
                "decoded": one.options,
                "version": one.version,
                "complete": one.flushed or any(other.after == one.id for other in manifest.sources),
                "parts": sum(part.source == one.id for part in manifest.parts),
                "bad": sum(sum(part.bad.values()) for part in manifest.parts if part.source == one.id),
            }
            for one in manifest.sources
        ],
        "unfinished_runs": sum(name.endswith(".run") for name in store.names(FOLDER)),
        "wrong": wrong,
    }


def _nodes(manifest: Manifest) -> dict[tuple[str, int], tuple[int, int, int, int]]:
    found: dict[tuple[str, int], tuple[int, set[str], int, int]] = {}
    for file in manifest.files():
        hand, date = (text.split("=", 1)[1] for text in file.path.split("/")[1:3])
        rows, days, first, last = found.get((hand, file.node), (0, set(), file.first_ns, file.last_ns))
        found[hand, file.node] = rows + file.rows, days | {date}, min(first, file.first_ns), max(last, file.last_ns)
    return {place: (rows, len(days), first, last) for place, (rows, days, first, last) in found.items()}


def _calibrations(manifest: Manifest) -> list[tuple[tuple[str, int], list[tuple[int, int]]]]:
    found: dict[tuple[str, int], list[tuple[int, int]]] = {}
    told = (one for part in manifest.parts for one in part.calibrations)
    for channel, node, crc, t_ns in sorted(told, key=lambda one: one[3]):
        of_node = found.setdefault((channel, node), [])
        if not of_node or of_node[-1][1] != crc:  # logs that were added apart tell it again
            of_node.append((t_ns, crc))
    return sorted(found.items())


def _utc(milliseconds: int) -> str:
    return (datetime(1970, 1, 1) + timedelta(milliseconds=milliseconds)).isoformat(timespec="milliseconds")


def lines(store: Store, manifest: Manifest, wrong: dict[str, str]) -> Iterator[str]:
    """Yield the content as text."""
    found = record(store, manifest, wrong)
    yield (
        f"{store.name}: {found['rows']} samples, {found['lost']} lost, {found['files']} files, "
        f"{found['bytes'] / 1e6:.1f} MB, generation {manifest.generation}"
    )
    for node in found["nodes"]:
        first, last = (_utc(round(node[name] * 1000)) for name in ("first_s", "last_s"))
        yield (
            f"{node['hand']} node {shown_id(node['node'])}: {node['rows']} samples on "
            f"{counted(node['days'], 'day')}, {first} to {last}"
        )
    for (channel, number), told in _calibrations(manifest):
        if len(told) > 1:
            texts = ", ".join(f"0x{crc:08X} from {_utc(t_ns // 10**6)}" for t_ns, crc in told)
            yield f"{channel} node {number}: rows of {counted(len(told), 'calibration')}: {texts}"
    for log in found["logs"]:
        bad = f", {log['bad']} bad lines" if log["bad"] else ""
        state = "" if log["complete"] else ", the rest is missing: run `tipforce decode` again"
        yield f"{log['name']}: {log['bytes']} bytes in {counted(log['parts'], 'part')}{bad}{state}"
    if found["unfinished_runs"]:
        yield f"runs that write now, or were ended: {found['unfinished_runs']}"
    for path, what in wrong.items():
        yield f"{path}: {what}"
    if wrong:
        yield "remove files that differ; then `tipforce decode` with their logs writes them again"
