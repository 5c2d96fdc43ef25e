"""Files of a user: those of user/, written by hand, and those that the command lines of made.txt write."""

from __future__ import annotations

import random
import shutil
from math import cos, radians, sin
from pathlib import Path

from bench.nets.logs import MICROSTRAIN_PER_NEWTON, write_logs
from bench.nets.trees import Tree, run_lines

HERE = Path(__file__).parent
_COB_IDS = {4: "0x40000480", 5: "0x400001C0", 6: "0x40000240"}
_DCF = "export dcf --node-id {1} --gauges {0} --settings in/gauges{0}.toml -o gauges{0}-{1}.dcf"


def make_files(tree: Tree, folder: Path) -> None:
    """Write all logs and files; ``made/`` has those that the commands of ``tree`` write, and what they print."""
    shutil.copytree(HERE / "user", folder)
    write_logs(folder)
    for gauges in (3, 5, 8):
        _write_readings(folder, gauges)
    for gauges in range(4, 9):
        more = (4, 5, 6) if gauges > 6 else (4, 5)
        lines = [f'"tpdo{k}.cob_id" = "$NODEID+{_COB_IDS[k]}"' for k in more]
        (folder / f"gauges{gauges}.toml").write_text("\n".join(["[objects]", *lines, ""]))
    exports = [_DCF.format(gauges, node) for gauges in range(4, 9) for node in (5, 6)]
    run_lines(tree, "\n".join([(HERE / "made.txt").read_text(), *exports]), folder / "made", folder)


def _write_readings(folder: Path, gauges: int) -> None:
    """Calibration data and gauge readings: pushes all around with tares, and one reading that is wrong."""
    pick = random.Random(gauges)
    names = ",".join(f"SG{k + 1}" for k in range(gauges))
    data, more = [f"{names},P_N,phi_deg,theta_deg"], [names]
    for k in range(60):
        P = 0.0 if k % 6 == 0 else pick.choice((2.2, 4.4))
        phi, theta = -90.0 + pick.choice((-30, 0, 15)), pick.choice((45.0, 80.0, 90.0, 105.0, 135.0))
        force = P * sin(radians(phi)), P * sin(radians(phi - theta)), P * cos(radians(phi))
        strains = [
            12.0 - 3 * n + sum(a * f for a, f in zip(row, force, strict=True)) + pick.gauss(0, 0.5)
            for n, row in enumerate(MICROSTRAIN_PER_NEWTON[:gauges])
        ]
        strains[1] += 150 * (k == 17)
        text = ",".join(f"{value:.2f}" for value in strains)
        data.append(f"{text},{P},{phi},{theta}")
        more.append(text)
        for _ in range(30):  # one gauge that is off by about as much as shows
            off = [0.0] * gauges
            off[pick.randrange(gauges)] = pick.uniform(-10.0, 10.0)
            more.append(",".join(f"{value + extra:.2f}" for value, extra in zip(strains, off, strict=True)))
    more += [",".join((text,) * gauges) for text in ("3300", "0", "nan")]
    (folder / f"data{gauges}.csv").write_text("\n".join([*data, ""]))
    (folder / f"gauges{gauges}.csv").write_text("\n".join([*more, ""]))
