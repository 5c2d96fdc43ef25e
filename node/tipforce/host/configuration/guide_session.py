"""The session of a guided calibration: a CSV of measurements, one row per step, on disk before the next step begins.

Besides the columns of every measurement file (`tipforce calibrate fit` reads it unchanged): ``step`` (number in the
plan, or extra), ``serial`` (of the node), ``taken`` (UTC) and ``var_j_k_ue2``, the covariance of one reading.
"""

from __future__ import annotations

import csv
import datetime
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.host.configuration.capture import Capture
from tipforce.host.configuration.guide_plan import EXTRA, Step
from tipforce.host.configuration.measurements import read_measurements
from tipforce.output_file import new_file


class Row(NamedTuple):
    """The values of one line that the guide needs; the fit reads the file itself."""

    step: int
    t_s: float
    taken: datetime.datetime
    mean_microstrain: FloatArray
    covariance_microstrain2: FloatArray
    """(n, n), of one reading."""
    samples: int
    unloaded: bool


class Session:
    """A session file of one node and one plan; created with the first row.

    Raises InputError for a file that is not a session, is damaged, or belongs to another node or plan, and leaves it
    unchanged. A last line truncated by an interruption is removed.
    """

    def __init__(self, path: str | Path, steps: Sequence[Step], serial: int, gauges: int, temperature: bool) -> None:
        self.path = Path(path)
        self.rows: list[Row] = []
        self.cut = False
        """The last line was truncated by an interruption, and has been removed."""
        self._serial, self._n = serial, gauges
        self._steps = {step.number: step for step in steps}
        self._columns = self._columns_of(temperature)
        self._content = self._read()
        whole = self._content[: self._content.rfind(b"\n") + 1]
        if whole:
            self._load(whole)
        elif not self._header().startswith(self._content):
            raise InputError(f"session {self.path}: not a session file; choose another --session")
        if whole != self._content:
            self.cut = True
            self._save(whole)

    @property
    def done(self) -> set[int]:
        """Numbers of the completed steps."""
        return {row.step for row in self.rows if row.step != EXTRA}

    def append(self, step: Step, capture: Capture) -> None:
        """Write the row of a step to disk. Raises InputError or WriteError if that fails."""
        now = datetime.datetime.now(datetime.UTC)
        t_s = 0.0
        if self.rows:
            # Rows stay in time order even if the clock is set.
            first = self.rows[0]
            t_s = max(self.rows[-1].t_s, first.t_s + (now - first.taken).total_seconds())
        self._save((self._content or self._header()) + self._line(step, capture, t_s, now).encode())
        row = Row(step.number, round(t_s, 3), now, capture.mean, capture.covariance, capture.count, step.mode == "tare")
        self.rows.append(row)

    def drop_last(self) -> int | None:
        """Remove the last row from the file; return the number of its step, None if there is no row."""
        if not self.rows:
            return None
        self._save(self._content[: self._content.rfind(b"\n", 0, -1) + 1])
        return self.rows.pop().step

    def noise_covariance_strain2(self) -> FloatArray:
        """Return the covariance of one reading from the scatter within all captures, (n, n), strain^2."""
        freedom = [row.samples - 1 for row in self.rows]
        mean = np.average([row.covariance_microstrain2 for row in self.rows], axis=0, weights=freedom)
        return np.asarray(mean * 1e-12, dtype=np.float64)

    def freedom(self) -> float:
        """Degrees of freedom of that covariance."""
        return float(sum(row.samples - 1 for row in self.rows))

    # --- the file -----------------------------------------------------------------------------------------------

    def _columns_of(self, temperature: bool) -> list[str]:
        gauges = [f"SG{k + 1}" for k in range(self._n)]
        degrees = ["temperature_degC"] if temperature else []
        variances = [f"var_{j + 1}_{k + 1}_ue2" for j, k in _upper(self._n)]
        load = ["P_N", "phi_deg", "theta_deg"]
        return ["t_s", *gauges, *load, *degrees, "weight", "mode", "step", "serial", "taken", *variances]

    def _header(self) -> bytes:
        return ",".join(self._columns).encode() + b"\n"

    def _line(self, step: Step, capture: Capture, t_s: float, now: datetime.datetime) -> str:
        degrees = []
        if "temperature_degC" in self._columns:
            if capture.temperature_degC is None:
                raise InputError("the node no longer sends its temperature, which the session has: check the node")
            degrees = [f"{capture.temperature_degC:.2f}"]
        return ",".join(
            [
                f"{t_s:.3f}",
                *(f"{value:.6f}" for value in capture.mean),
                *(repr(value) for value in step.load[:3]),
                *degrees,
                str(capture.count),
                step.mode,
                str(step.number) if step.number != EXTRA else "extra",
                str(self._serial),
                now.isoformat(timespec="milliseconds"),
                *(f"{capture.covariance[j, k]:.8g}" for j, k in _upper(self._n)),
            ]
        ) + "\n"  # fmt: skip

    def _read(self) -> bytes:
        try:
            return self.path.read_bytes()
        except FileNotFoundError:
            if not self.path.absolute().parent.is_dir():
                raise InputError(f"session {self.path}: the directory does not exist; create it first") from None
            return b""
        except OSError as error:
            raise InputError(f"session {self.path}: {error.strerror}") from error

    def _save(self, content: bytes) -> None:
        """Replace the file, synchronously to disk."""
        if self._read() != self._content:
            raise InputError(f"session {self.path}: another program has changed it; start the same command again")
        with new_file(self.path) as partial, partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if os.name == "posix":  # so that the new name is on disk, too
            folder = os.open(self.path.absolute().parent, os.O_RDONLY)
            os.fsync(folder)
            os.close(folder)
        self._content = content

    def _load(self, content: bytes) -> None:
        try:
            lines = content.decode("utf-8-sig").splitlines(keepends=True)
        except UnicodeDecodeError:
            raise InputError(f"session {self.path}: not UTF-8, not a session file") from None
        self._check_header(next(csv.reader(lines[:1])))
        bad = read_measurements(self.path, loads=True).bad if len(lines) > 1 else ()
        faults = [row for row in bad if row.line <= len(lines)]  # without the truncated line
        if faults:
            raise InputError(f"session {self.path}: {faults[0]}; correct that line, or remove it to repeat the step")
        self.rows = [self._row(number, line) for number, line in enumerate(lines[1:], 2)]

    def _check_header(self, names: list[str]) -> None:
        gauges = sum(name.startswith("SG") for name in names)
        self._columns = self._columns_of("temperature_degC" in names)
        if {"step", "serial", "taken", "SG1"} <= set(names) and gauges != self._n:
            raise InputError(f"session {self.path}: it has {gauges} gauges, the node has {self._n}")
        if names != self._columns:
            missing = [name for name in self._columns if name not in names]
            what = f"the column {missing[0]} is missing" if missing else "the columns are not those of a session"
            raise InputError(f"session {self.path}: not a session file ({what}); choose another --session")

    def _row(self, number: int, text: str) -> Row:
        place = f"session {self.path}: line {number}"
        cells = dict(zip(self._columns, next(csv.reader([text])), strict=True))
        try:
            step = EXTRA if cells["step"] == "extra" else int(cells["step"])
            serial, samples = int(cells["serial"]), round(float(cells["weight"]))
            taken = datetime.datetime.fromisoformat(cells["taken"])
            P, phi, theta = (float(cells[name]) for name in ("P_N", "phi_deg", "theta_deg"))
            upper = [float(cells[f"var_{j + 1}_{k + 1}_ue2"]) for j, k in _upper(self._n)]
            mean = np.array([float(cells[f"SG{k + 1}"]) for k in range(self._n)])
            usable = taken.tzinfo is not None and samples >= 2 and all(map(math.isfinite, upper))
        except ValueError:
            usable = False
        if not usable:
            raise InputError(f"{place}: not a line of a session; correct it, or remove it to repeat the step")
        if serial != self._serial:
            raise InputError(f"{place}: of the node with serial {serial}, this one has serial {self._serial}")
        self._check_step(place, Step(step, P, phi, theta, cells["mode"], ""))
        covariance = np.zeros((self._n, self._n))
        for (j, k), value in zip(_upper(self._n), upper, strict=True):
            covariance[j, k] = covariance[k, j] = value
        return Row(step, float(cells["t_s"]), taken, mean, covariance, samples, cells["mode"] == "tare")

    def _check_step(self, place: str, step: Step) -> None:
        """Check a row against its step in the plan."""
        planned = self._steps.get(step.number)
        if step.number == EXTRA:
            if step.mode != "tare":
                raise InputError(f"{place}: an extra step is {step}, allowed is unloaded")
            return
        if planned is None:
            wrong = f"step {step.number} ({step}), this plan has {len(self._steps)} steps"
        elif step.load != planned.load:
            wrong = f"step {step.number} is {step}, in this plan it is {planned}"
        else:
            return
        raise InputError(f"{place}: {wrong}: another plan; pass the plan of this session, or another --session")


def _upper(n: int) -> list[tuple[int, int]]:
    return [(j, k) for j in range(n) for k in range(j, n)]
