"""What a dataset holds, by its manifest, and which of its files are not as the manifest says."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from typing import Any

import numpy as np

from tipforce.host.dataset.manifest import Manifest, files_of
from tipforce.host.dataset.reader import tally
from tipforce.host.dataset.store import FOLDER, Store
from tipforce_tools.cli.listening import counted

_MB = 1_000_000


def wrong_files(store: Store, manifest: Manifest, *, hashes: bool) -> dict[str, str]:
    """Return by path what is wrong with a file: it is missing, or its size or (with ``hashes``) its content differs."""
    found = {}
    for file in {file.path: file for file in files_of(manifest.parts)}.values():
        try:
            with store.open(file.path) as stream:
                changed = hashes and hashlib.sha256(stream.read()).hexdigest() != file.sha256
                if changed or stream.seek(0, os.SEEK_END) != file.bytes:
                    found[file.path] = "differs from what was written"
        except OSError as error:
            found[file.path] = "is missing" if isinstance(error, FileNotFoundError) else str(error)
    return found


def record(store: Store, manifest: Manifest, wrong: dict[str, str]) -> dict[str, Any]:
    """Return the content as a JSON record."""
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
    """Return by hand and node-id: rows, days, first and last time in nanoseconds."""
    found: dict[tuple[str, int], tuple[int, set[str], int, int]] = {}
    for file in manifest.files():
        hand, date = (text.split("=", 1)[1] for text in file.path.split("/")[1:3])
        rows, days, first, last = found.get((hand, file.node), (0, set(), file.first_ns, file.last_ns))
        found[hand, file.node] = rows + file.rows, days | {date}, min(first, file.first_ns), max(last, file.last_ns)
    return {place: (rows, len(days), first, last) for place, (rows, days, first, last) in found.items()}


def _calibrations(manifest: Manifest) -> list[tuple[tuple[str, int], list[tuple[int, int]]]]:
    """Return by channel and node the times and CRC-32 of its calibrations."""
    found: dict[tuple[str, int], list[tuple[int, int]]] = {}
    told = (one for part in manifest.parts for one in part.calibrations)
    for channel, node, crc, t_ns in sorted(told, key=lambda one: one[3]):
        of_node = found.setdefault((channel, node), [])
        if not of_node or of_node[-1][1] != crc:  # logs that were added apart tell it again
            of_node.append((t_ns, crc))
    return sorted(found.items())


def lines(store: Store, manifest: Manifest, wrong: dict[str, str]) -> Iterator[str]:
    """Yield the content as text."""
    found = record(store, manifest, wrong)
    yield (
        f"{store.name}: {found['rows']} samples, {found['lost']} lost, {found['files']} files, "
        f"{found['bytes'] / _MB:.1f} MB, generation {manifest.generation}"
    )
    for node in found["nodes"]:
        first, last = (str(np.datetime64(int(node[name] * 1000), "ms")) for name in ("first_s", "last_s"))
        yield (
            f"{node['hand']} node {node['node']} (0x{node['node']:02X}): {node['rows']} samples on "
            f"{counted(node['days'], 'day')}, {first} to {last}"
        )
    for (channel, number), told in _calibrations(manifest):
        if len(told) > 1:
            texts = ", ".join(f"0x{crc:08X} from {np.datetime64(t_ns // 10**6, 'ms')}" for t_ns, crc in told)
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
