"""Write the buffer as CSV: one line per finger and row, in small portions so that reception continues."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

from tipforce_tools.view.blocks import MISSING
from tipforce_tools.view.model import Model

_ROWS = 200
_PAUSE_S = 0.002


def csv_chunks(model: Model) -> Iterator[bytes]:
    """Yield all rows of the buffer, oldest first. Empty cell: unknown value; status is 2120h, empty if missing."""
    fingers, (start_ns, end_ns) = model.fingers, model.span_ns()
    strains = ",".join(f"SG{k + 1}_ue" for k in range(model.gauges))
    yield f"t_s,node_id,name,P_N,phi_deg,theta_deg,u_P_N,u_phi_deg,u_theta_deg,{strains},status\n".encode()
    heads = [f"{finger.node_id},{_quoted(finger.name)}," for finger in fingers]
    after_ns = start_ns - 1
    while True:
        block = model.rows_after(after_ns, _ROWS, end_ns)
        if not len(block) or block.status.shape[1] != len(fingers):
            return
        after_ns = int(block.t_ns[-1])
        lines = []
        parts = zip(
            block.t_ns.tolist(), block.contact.tolist(), block.u.tolist(), block.gauges.tolist(),
            block.status.tolist(), strict=True,
        )  # fmt: skip
        for t_ns, contact, u, gauges, status in parts:
            t = f"{t_ns // 1_000_000_000}.{t_ns % 1_000_000_000:09d},"
            for k, head in enumerate(heads):
                cells = [_cell(value) for value in (*contact[k], *u[k], *gauges[k])]
                flags = "" if status[k] & MISSING else f"{status[k] & 0xFF}"
                lines.append(f"{t}{head}{','.join(cells)},{flags}\n")
        yield "".join(lines).encode()
        time.sleep(_PAUSE_S)


def _cell(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"


def _quoted(text: str) -> str:
    """Return a name as a cell. A name that begins like a formula gets a quote, so that no spreadsheet evaluates it."""
    if text[:1] in ("=", "+", "-", "@"):
        text = "'" + text
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n\r') else text
