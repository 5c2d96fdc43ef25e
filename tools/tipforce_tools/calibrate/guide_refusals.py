"""Checks of a capture: quiet, new and complete samples; otherwise a reason and a remedy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tipforce.dictionary import table
from tipforce.host.configuration.capture import RESOLUTION_MICROSTRAIN, Capture


class Refusal(NamedTuple):
    """Why a capture is refused, and the remedy."""

    reason: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.reason}: {self.remedy}"


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a quiet capture, in microstrain."""

    std_microstrain: float = 5.0
    """Standard deviation of the readings of a gauge."""
    drift_microstrain: float = 2.0
    """Change of the straight line through the readings of a gauge from the first to the last."""


def refusals(capture: Capture, limits: Limits) -> list[Refusal]:
    """Return the reasons to refuse a capture, the most specific first; empty for a good one."""
    found = _unusable(capture)
    if found:
        return found
    quiet: list[Refusal] = []
    drift_u = capture.std * np.sqrt(12.0 / capture.count)
    for k, (std, drift, u) in enumerate(zip(capture.std, capture.drift, drift_u, strict=True)):
        if std > limits.std_microstrain:
            quiet.append(Refusal(
                f"not quiet: SG{k + 1} scatters by {std:.1f} microstrain, allowed are {limits.std_microstrain:g}",
                "wait until the weight is at rest; avoid contact and air flow (--max-std)",
            ))  # fmt: skip
        elif abs(drift) > max(limits.drift_microstrain, 4.0 * u):
            quiet.append(Refusal(
                f"not quiet: SG{k + 1} drifts by {drift:+.1f} microstrain within the capture, allowed are "
                f"{limits.drift_microstrain:g}",
                "wait until rope and temperature have settled (--max-drift)",
            ))  # fmt: skip
    return quiet or _stuck(capture)


def _unusable(capture: Capture) -> list[Refusal]:
    of = f"of {capture.asked} samples"
    found = []
    if capture.silent and not capture.count:
        found.append(Refusal(
            "silent: no gauge PDO on SYNC, although the node responds to SDO",
            "check for another NMT master and for bus overload; try again",
        ))  # fmt: skip
    if capture.faulty:
        names = [name.replace("_", " ") for bit, name, _ in table.FAULT_BITS if capture.faults >> bit & 1]
        found.append(Refusal(
            f"front-end fault in {capture.faulty} {of} (2124h = 0x{capture.faults:04X}"
            f"{': ' + ', '.join(names) if names else ''})",
            "check the wiring and the supply of the gauges",
        ))  # fmt: skip
    hit = [f"SG{k + 1}" for k, count in enumerate(capture.saturated) if count]
    if hit:
        found.append(Refusal(
            f"saturated: {', '.join(hit)} in up to {max(capture.saturated)} {of}",
            "use a smaller weight, or check the gauge's wiring",
        ))  # fmt: skip
    if not found and capture.count < capture.asked:
        if capture.repeated > capture.stale:
            found.append(Refusal(
                f"the sample counter does not change ({capture.repeated} repeated)",
                "the node no longer measures: reset it",
            ))  # fmt: skip
        else:
            found.append(Refusal(
                f"stale: only {capture.count} {of} were new ({capture.stale} stale, {capture.silent} missing)",
                "the converter delivers no samples: check the node, or increase --period",
            ))  # fmt: skip
    return found


def _stuck(capture: Capture) -> list[Refusal]:
    """Return a refusal for gauges with constant readings while another gauge has noise."""
    still = np.ptp(capture.microstrain, axis=0) == 0.0
    if capture.count < 20 or capture.std.max() < 2.0 * RESOLUTION_MICROSTRAIN or not still.any():
        return []
    names = ", ".join(f"SG{k + 1}" for k in np.flatnonzero(still))
    return [Refusal(f"stuck: {names} reads a constant value, other gauges do not", "check the gauge's wiring")]
