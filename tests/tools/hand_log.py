"""A log of a hand, as a scene writes it, and single contacts of a node."""

import math
import struct
from pathlib import Path

from tools.rig import exit_code

START_S = 1_700_000_000
SCENE = """
start = 2023-11-14T22:13:20Z
duration_s = {seconds}
sync_hz = 100
nodes = [{{ ids = {ids}, pdos = ["gauges", "contact", "health"], heartbeat_ms = 500 }}]
loads = [{{ kind = "history", t_s = {t_s}, P_N = {P_N}, phi_deg = {phi_deg}, theta_deg = {theta_deg} }}]
noise = {{ gauge_microstrain = 0.5 }}
"""
FAULTS = """
faults = [
    { kind = "open", nodes = [5], at_s = 0.6, until_s = 0.8 },
    { kind = "silent", nodes = [5], at_s = 1.5, until_s = 1.6 },
    { kind = "saturate", nodes = [5], at_s = 1.8, until_s = 1.85 },
]
"""


def write_hand_log(path: Path, ids: tuple[int, ...], seconds: float, faults: str = "") -> Path:
    """A press every second that grows and fades; its direction turns round through 180 degrees. 100 SYNCs a second."""
    t_s = [k / 20 for k in range(41)]
    P_N = [max(0.0, 3.0 * math.sin(2.0 * math.pi * (t + 0.65))) for t in t_s]
    phi_deg, theta_deg = [130 + 60 * t for t in t_s], [60 * t - 50 + 15 * math.sin(7 * t) for t in t_s]
    load = {"t_s": t_s, "P_N": P_N, "phi_deg": phi_deg, "theta_deg": theta_deg}
    scene = path.with_suffix(".toml")
    scene.write_text(SCENE.format(seconds=seconds, ids=list(ids), **load) + faults)
    assert exit_code(["run", scene, "-q", "-o", path]) == 0
    return path


def contact_pdo(
    node_id: int, P: float, phi: float, theta: float, status: int = 3, counter: int = 0
) -> tuple[int, bytes]:
    """One TPDO2 (None: NaN is unknown)."""
    raw = [
        -0x8000 if math.isnan(value) else round(value * scale) for value, scale in ((P, 1000), (phi, 100), (theta, 100))
    ]
    return 0x280 + node_id, struct.pack("<hhhBB", *raw, status, counter & 0xFF)
