"""What a page gets: pictures, envelopes and events by its playhead, the drawing of a finger, the rows as CSV."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from tipforce.errors import InputError
from tipforce.samples.reasons import NO_ANSWER
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.published import GAUGE_LENGTH_M
from tipforce.sensor.structure.strain import Gauge, GaugePosition, gauge_name, place, strain_row
from tipforce.watching.feeds import Finger
from tipforce_tools.page.model import Charted, Model, Picture

MAX_BINS = 1500
"""Limit per message: a browser that reconnects late gets the newest ones."""
MAX_EVENTS = 200
SPEEDS = 0.05, 50.0
_BIN_DIGITS = 4
_ROWS = 200
_PAUSE_S = 0.002


class Cursor:
    """Position of one browser in the stream: the present, or a moment that advances from ``start_ns`` at ``speed``. A
    late browser gets all missed rows as envelopes, in one message: there is no queue."""

    def __init__(
        self, model: Model, bin_ns: int, start_ns: int | None = None, speed: float = 1.0, after_event: int = 0,
        what: Charted = "contact", clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        if not SPEEDS[0] <= speed <= SPEEDS[1]:
            raise InputError(f"speed {speed:g}: allowed are {SPEEDS[0]:g} to {SPEEDS[1]:g}")
        self._model, self._start_ns, self._speed, self._clock = model, start_ns, speed, clock
        self._begun_s = clock()
        self._bin_ns, self._what, self._event = bin_ns, what, after_event
        self._bin = self.now_ns()[0] // bin_ns

    def now_ns(self) -> tuple[int, bool]:
        """Return (time, ended): it stops at the end of a log; at the end of a live recording it follows the present."""
        present = self._model.now_ns()
        if self._start_ns is None:
            return present, not self._model.live
        moment = self._start_ns + round((self._clock() - self._begun_s) * self._speed * 1e9)
        moment = max(moment, self._model.span_ns()[0])
        if moment >= present:
            self._start_ns = None if self._model.live else self._start_ns
            return present, not self._model.live
        return moment, False

    def message(self) -> Picture:
        """Return the next message; the last one has ended."""
        model = self._model
        now_ns, ended = self.now_ns()
        picture = model.picture(now_ns)
        last = now_ns // self._bin_ns
        first = max(self._bin, last - MAX_BINS + 1)
        # The last bin is not complete: it is sent again.
        self._bin = last
        picture.bins = envelope_message(model, first, last, self._bin_ns, self._what)
        live = model.live and now_ns >= model.span_ns()[1]
        picture.events = model.events(self._event, None if live else now_ns)[-MAX_EVENTS:] or None
        if picture.events:
            self._event = picture.events[-1].number
        picture.ended = ended
        return picture


def envelope_message(model: Model, first: int, last: int, width_ns: int, what: Charted) -> dict[str, Any]:
    """Encode bins, each with k x (3 q + 1) numbers: low, high and u of q quantities, and the number of unknown rows."""
    index, values = model.envelope(first, last, width_ns, what)
    rows = np.round(values, _BIN_DIGITS).reshape(len(values), values.shape[1] * values.shape[2])
    return {"i": index.tolist(), "v": rows.tolist()}


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
                values = (*contact[k], *u[k], *gauges[k])
                cells = ["" if math.isnan(value) else f"{value:.6g}" for value in values]
                flags = "" if status[k] & NO_ANSWER else f"{status[k] & 0xFF}"
                lines.append(f"{t}{head}{','.join(cells)},{flags}\n")
        yield "".join(lines).encode()
        time.sleep(_PAUSE_S)


def _quoted(text: str) -> str:
    """Return a name as a cell. A name that begins like a formula gets a quote, so that no spreadsheet evaluates it."""
    if text[:1] in ("=", "+", "-", "@"):
        text = "'" + text
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n\r') else text


MM = 1e3


def drawing(finger: Finger, gauges: int) -> dict[str, Any]:
    """Return the drawing of a finger: lengths in mm, x to the right, y from the axis of the horizontal beam upwards.
    ``faces``: microstrain per newton of F1, F2, F3 at both ends of each face of each beam, linear between."""
    geometry = finger.geometry
    return {
        "node_id": finger.node_id, "label": finger.label, "layout": finger.layout,
        "calibrated_here": finger.calibration is not None,
        "a": geometry.a_m * MM, "d": geometry.d_m * MM, "r": geometry.r_m * MM,
        "h1": geometry.h1_m * MM, "h2": geometry.h2_m * MM,
        "gauges": [_gauge(geometry, gauge) for gauge in finger.gauges[:gauges]],
        "faces": _faces(geometry),
    }  # fmt: skip


def _gauge(geometry: Geometry, gauge: Gauge) -> dict[str, Any]:
    """Return its name, both ends of its centre line on the beam's surface, and the outward direction."""
    spot = place(geometry, gauge)
    length_m = geometry.a_m if spot.beam == "H" else geometry.d_m
    begin = min(max(spot.position_m - 0.5 * GAUGE_LENGTH_M, 0.0), length_m - GAUGE_LENGTH_M)
    ends = begin * MM, (begin + GAUGE_LENGTH_M) * MM
    sign = -1.0 if spot.side == "left" else 1.0
    half_h1, half_h2 = 0.5 * geometry.h1_m * MM, 0.5 * geometry.h2_m * MM
    if spot.beam == "H":
        up = 1.0 if spot.face == "upper" else -1.0
        # Drawn beside the vertical beam; the beam model measures from its axis.
        shift = half_h2 if begin == 0.0 and up < 0 else 0.0
        (x0, x1), (y0, y1), out = [sign * (shift + s) for s in ends], (up * half_h1, up * half_h1), (0.0, up)
    else:
        (x0, x1), (y0, y1), out = (sign * half_h2, sign * half_h2), [-half_h1 - s for s in ends], (sign, 0.0)
    return {"name": gauge_name(gauge), "beam": spot.beam, "from": [x0, y0], "to": [x1, y1], "out": out}


def largest_strain_per_newton(geometry: Geometry) -> float:
    """Return the largest strain of a face, in microstrain, for 1 N of F1, F2 or F3."""
    return max(float(np.abs(face["microstrain_per_newton"]).max()) for face in _faces(geometry))


@lru_cache(maxsize=16)
def _faces(geometry: Geometry) -> list[dict[str, Any]]:
    faces = []
    for beam, side, face in _FACES:
        length_m = geometry.a_m if beam == "H" else geometry.d_m
        ends = [GaugePosition(beam, side, position, face) for position in (0.0, length_m)]
        rows = np.array([strain_row(geometry, *end) for end in ends]) * 1e6
        faces.append({"beam": beam, "side": side, "face": face, "microstrain_per_newton": rows.tolist()})
    return faces


_FACES: Sequence[tuple[Literal["H", "V"], Literal["left", "right"], Literal["lower", "upper"]]] = (
    ("H", "left", "lower"), ("H", "right", "lower"), ("H", "left", "upper"), ("H", "right", "upper"),
    ("V", "left", "lower"), ("V", "right", "lower"),
)  # fmt: skip
