"""Cost against work, as exponents: processor time over frames, nodes, gauges, fingers and parts of a dataset.

    python -m bench.exponents    five lines for docs/performance.md; some minutes

The exponent is the slope of log cost over log work by least squares: 1 where cost is proportional to work, less where a
constant part counts. The range is that of the slopes of single rounds; within a round, the sizes take turns."""

import statistics
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from bench.decode import hand_traffic, write_log
from bench.device import calibrated_node, steps
from bench.measure import TIPFORCE, arguments, command_s, cpu_s, in_turns, machine, table
from bench.scale import many_parts

from tipforce import Estimator
from tipforce.host.frames.frame_array import frame_array
from tipforce.host.hand.rows import Collector, rows_one_by_one
from tipforce.samples.record import RowContacts
from tipforce.scene.delivered import structure_calibration
from tipforce.sensor.structure.strain import FABRICATED

POINTS = ("L", "R", "T", "U", "K_V", "S_V", "K_H", "S_H")
CONTACT = bytes.fromhex("84032823401f03")  # 0.9 N, 90 and 80 degrees, status; the counter follows


def frames(folder: Path, count: int) -> Callable[[], float]:
    """Return the processor time of the summary of a log."""
    log = folder / f"{count}.log"
    write_log(log, hand_traffic(count, 5, 1))
    return lambda: command_s([*TIPFORCE, "decode", "--summary", "-q", "-o", "-", log], stdout=-3)[0]


def nodes(count: int) -> Callable[[], float]:
    """SYNCs to so many nodes."""
    return partial(cpu_s, steps([calibrated_node(k + 1) for k in range(count)], [(0x80, b"")], 40, 2000))


def gauges(count: int) -> Callable[[], float]:
    """Contacts of 2000 readings of so many gauges, one by one."""
    estimator = Estimator(structure_calibration(FABRICATED, POINTS[:count], 0.5))
    readings = np.random.default_rng(1).normal(0.0, 300.0, (2000, count)).tolist()
    return partial(cpu_s, lambda: [estimator(reading) for reading in readings])


def fingers(count: int) -> Callable[[], float]:
    """500 rows of so many fingers, each row fed at once."""
    node_ids = range(1, count + 1)
    contacts = RowContacts(node_ids, [f"finger {k}" for k in node_ids])
    rows = [frame_array([(10**9 + k * 10**6, 0x280 + node_id, CONTACT + bytes((k & 255,))) for node_id in node_ids])
            for k in range(500)]  # fmt: skip

    def run() -> None:
        collector = Collector(node_ids)
        for k, row in enumerate(rows):
            rows_one_by_one(collector.add(row, 1.0 + 1e-3 * k), contacts)

    return partial(cpu_s, run)


def parts(count: int) -> Callable[[], float]:
    """The manifest of a dataset of so many parts: made, committed, read and committed again."""

    def run() -> None:
        with tempfile.TemporaryDirectory() as folder:
            many_parts(Path(folder), count)

    return partial(cpu_s, run)


def exponent(sizes: Sequence[int], costs: Sequence[float]) -> float:
    """Return the slope of log cost over log size by least squares."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def row(name: str, sizes: Sequence[int], work: Callable[[int], Callable[[], float]], rounds: int) -> list[str]:
    """Return a line of the table."""
    ways = {str(size): work(size) for size in sizes}
    in_turns(ways, 1)
    costs = list(zip(*in_turns(ways, rounds).values(), strict=True))
    slopes = sorted(exponent(sizes, round_) for round_ in costs)
    middle = exponent(sizes, [statistics.median(column) for column in zip(*costs, strict=True)])
    return [name, f"{sizes[0]} to {sizes[-1]}", f"{middle:.2f} ({slopes[0]:.2f} to {slopes[-1]:.2f})"]


def main() -> None:
    arguments(__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = [
            row("frames: `decode --summary`", [10**5, 10**6, 10**7], partial(frames, Path(folder)), 3),
            row("nodes: 40 SYNCs", [1, 4, 16, 64, 127], nodes, 5),
            row("gauges: 2000 contacts", list(range(3, 9)), gauges, 5),
            row("fingers: 500 live rows", [1, 2, 5, 10, 15], fingers, 5),
            row("parts of a dataset: manifest", [10, 100, 1000, 10**4], parts, 3),
        ]
    print(machine())
    print(table(["work", "sizes", "exponent"], rows))


if __name__ == "__main__":
    main()
