"""Run one scene in a Python of its own and tell, as JSON, what was loaded, made, computed and sent."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from tipforce.scene import read_scene, run_scene

CALLS = {"contact": 0, "force": 0}


def count_calls() -> None:
    from tipforce.fingertip.calibration import Active
    from tipforce.sensor.contact import scalar

    contact, node_force = scalar.contact_of, Active.force

    def counted_contact(force: scalar.ScaledForce | None, pull: bool) -> tuple[float, float, float, float]:
        CALLS["contact"] += 1
        return contact(force, pull)

    def counted_force(self: Active, *values: Any) -> tuple[float, float, float]:
        CALLS["force"] += 1
        return node_force(self, *values)

    scalar.contact_of = counted_contact
    Active.force = counted_force  # type: ignore[assignment, method-assign]


def main(path: str, duration: str) -> None:
    """One scene, for a duration in seconds or, with "", its own."""
    count_calls()
    outcome = run_scene(read_scene(path), Path(path).parent, float(duration) if duration else None)
    told = {
        "modules": sorted(name for name in sys.modules if name.startswith(("tipforce", "canopen_device"))),
        "packages": sorted({name.partition(".")[0] for name in sys.modules}), "built": list(outcome.built),
        "frames": {str(can_id): count for can_id, count in outcome.frames_by_id.items()},
        "emcy": {str(finger.node_id): list(finger.emcy) for finger in outcome.fingers},
        "failed": [f"{check.node_id}: {check.expected}: {check.found}" for check in outcome.checks if not check.ok],
        "syncs": outcome.syncs, "calls": CALLS,
    }  # fmt: skip
    print(json.dumps(told))


if __name__ == "__main__":
    main(*sys.argv[1:])
