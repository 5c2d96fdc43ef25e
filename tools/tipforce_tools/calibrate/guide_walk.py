"""Execute the steps of a guided calibration: show the instruction, wait, capture, check, write the row; at the end fit.
A capture is checked for quiet, new and complete samples; otherwise it is refused with a reason and a remedy."""

import argparse
import sys
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from tipforce.dictionary import objects as od
from tipforce.dictionary import table
from tipforce.errors import InputError, NoResponseError, RefusedError, TipforceError
from tipforce.host.configuration.capture import RESOLUTION_MICROSTRAIN, Capture, GaugeReader
from tipforce.host.configuration.fitting import FitRequest, fitted, limit_of
from tipforce.host.configuration.guide import EXTRA, EXTRA_TARE, Session, Step
from tipforce.host.configuration.measurements import read_measurements
from tipforce.host.network.bus import Bus
from tipforce.host.network.finger import Finger, Identity
from tipforce.sensor.calibration.distributions import variance_factors
from tipforce.sensor.calibration.result import matrix_to_digits, to_digits
from tipforce.sensor.contact.redundancy import weighted_inverse
from tipforce_tools.calibrate import fit
from tipforce_tools.calibrate.fit_report import publish, write
from tipforce_tools.cli import bus_flags, common


def _fault_names(faults: int) -> str:
    return ", ".join(name.replace("_", " ") for bit, name, _ in table.FAULT_BITS if faults >> bit & 1)


def _checked_node(connection: Bus, args: argparse.Namespace) -> tuple[Finger, GaugeReader, Identity]:
    """Return the node, after checking that it measures; a note says what it is."""
    name = common.shown_node(args.node)
    finger = connection.finger(args.node)
    identity = finger.identity()
    if not identity.is_fingertip:
        raise InputError(f"{name}: product code 0x{identity.product:08X} is not a fingertip of this dictionary")
    if args.auto and not identity.simulated:
        raise InputError(f"{name} has real gauges: --auto needs a simulated node; leave it out and hang weights")
    reader = GaugeReader(connection, args.node, identity.gauges, args.period * 1e-3)
    if not reader.moves():
        raise RefusedError(f"{name}: its sample counter (2121h) does not change: it does not measure; reset it")
    faults = finger.sdo.read(od.FAULTS)
    if faults >> table.FAULT_NO_DATA:
        names = _fault_names(faults)
        raise RefusedError(f"{name}: front-end fault 2124h = 0x{faults:04X} ({names}): repair it before calibration")
    temperature = reader.temperature_degC()
    crc = finger.sdo.read(od.CALIBRATION_ACTIVE_CRC)
    what = f"{'simulated ' if identity.simulated else ''}fingertip, {identity.gauges} gauges, serial {identity.serial}"
    held = f"calibrated (CRC-32 0x{crc:08X})" if crc else "not calibrated yet"
    degrees = "temperature unknown" if temperature is None else f"{temperature:.2f} degC"
    common.note(f"{name}: {what}; {held}; {degrees}; measures, no fault")
    return finger, reader, identity


def refusals(capture: Capture, max_std_microstrain: float, max_drift_microstrain: float) -> list[str]:
    """Return the reasons to refuse a capture, each with its remedy, the most specific first. The limits are of the
    standard deviation of a gauge's readings, and of the change of the straight line through them from first to last."""
    texts = _unusable(capture)
    if texts:
        return texts
    drift_u = capture.std * np.sqrt(12.0 / capture.count)
    for k, (std, drift, u) in enumerate(zip(capture.std, capture.drift, drift_u, strict=True)):
        if std > max_std_microstrain:
            texts.append(
                f"not quiet: SG{k + 1} scatters by {std:.1f} microstrain, allowed are {max_std_microstrain:g}: "
                "wait until the weight is at rest; avoid contact and air flow (--max-std)"
            )
        elif abs(drift) > max(max_drift_microstrain, 4.0 * u):
            texts.append(
                f"not quiet: SG{k + 1} drifts by {drift:+.1f} microstrain within the capture, allowed are "
                f"{max_drift_microstrain:g}: wait until rope and temperature have settled (--max-drift)"
            )
    still = np.ptp(capture.microstrain, axis=0) == 0.0
    if not texts and still.any() and capture.count >= 20 and capture.std.max() >= 2.0 * RESOLUTION_MICROSTRAIN:
        names = ", ".join(f"SG{k + 1}" for k in np.flatnonzero(still))
        texts.append(f"stuck: {names} reads a constant value, other gauges do not: check the gauge's wiring")
    return texts


def _unusable(capture: Capture) -> list[str]:
    of = f"of {capture.asked} samples"
    texts = []
    if capture.silent and not capture.count:
        silent = "silent: no gauge PDO on SYNC, although the node responds to SDO"
        texts.append(f"{silent}: check for another NMT master and for bus overload; try again")
    if capture.faulty:
        names = _fault_names(capture.faults)
        fault = f"front-end fault in {capture.faulty} {of} (2124h = 0x{capture.faults:04X}{names and ': ' + names})"
        texts.append(f"{fault}: check the wiring and the supply of the gauges")
    hit = [f"SG{k + 1}" for k, count in enumerate(capture.saturated) if count]
    if hit:
        saturated = f"saturated: {', '.join(hit)} in up to {max(capture.saturated)} {of}"
        texts.append(f"{saturated}: use a smaller weight, or check the gauge's wiring")
    if not texts and capture.count < capture.asked:
        unchanged = f"the sample counter does not change ({capture.repeated} repeated): the node no longer measures"
        stale = (
            f"stale: only {capture.count} {of} were new ({capture.stale} stale, {capture.silent} missing): "
            "the converter delivers no samples: check the node, or increase --period"
        )
        texts.append(f"{unchanged}: reset it" if capture.repeated > capture.stale else stale)
    return texts


KEYS = "Enter: capture, s: skip, r: repeat the last, q: save and quit"
_LOAD = (od.SIMULATION_P, od.SIMULATION_PHI, od.SIMULATION_THETA)
_MOVED_SHARE = 0.05  # of the largest reading: an unloaded reading further from the last one gets a remark
_UNMOVED_MICROSTRAIN = 0.5
_AUTO_TRIES = 2


def ask(question: str) -> str:
    """Return the user's answer in lower case without blanks. Raises InputError at the end of the input."""
    sys.stdout.flush()
    print(question, end=" ", file=sys.stderr, flush=True)
    line = sys.stdin.readline()
    if not line:
        print(file=sys.stderr)
        raise InputError("end of input: the guide needs a user to hang weights (--auto is for a simulated node)")
    return line.strip().lower()


class Walk:
    """One run at the node; the session holds its results. Raises NoResponseError without a node, InputError for another
    device or --auto with real gauges, RefusedError for a node with a front-end fault or without new samples."""

    def __init__(self, args: argparse.Namespace, steps: Sequence[Step], connection: Bus) -> None:
        self._args, self._steps = args, steps
        self._client, self._reader, identity = _checked_node(connection, args)
        self._request = FitRequest(**fit.requested(args), serial=identity.serial)
        self._request.check_gauges(identity.gauges, "the node")
        _ = self._request.model  # wrong flags of the fit show before an hour of weights
        path = Path(args.session or f"session-{identity.serial}.csv")
        has_temperature = self._reader.temperature_degC() is not None
        self._session = session = Session(path, steps, identity.serial, identity.gauges, has_temperature)
        loads = sum(step.mode != "tare" for step in steps)
        common.note(
            f"plan: {loads} loads and {len(steps) - loads} unloaded readings; by {self._reader.how}; session {path}"
        )
        if session.cut:
            common.note(f"session {path}: its last line was truncated by an interruption and is removed")
        self._skipped: set[int] = set()
        missing = [step for step in steps if step.number not in session.done]
        self._todo = deque(missing)
        if session.rows and missing:
            common.note(f"continuing: {len(session.done)} of {len(steps)} steps done, {len(missing)} to do")
            if missing[0].mode != "tare":
                self._todo.appendleft(EXTRA_TARE)

    def run(self) -> int:
        """Execute the remaining steps, fit and apply: 0, as for a user who quits; 1 if --auto gets no good capture.
        Raises InputError if the rows do not determine a calibration, RefusedError if the node refuses it."""
        try:
            while (code := self._take_steps()) is None:
                if not self._finish():
                    return 0
                self._redo_last()
        except (KeyboardInterrupt, Exception):
            self._say_where()
            raise
        finally:
            self._reader.stop()
        self._say_where()
        return code

    def _take_steps(self) -> int | None:
        sdo, auto = self._client.sdo, self._args.auto
        before = [sdo.read(entry) for entry in _LOAD] if auto else []
        try:
            while self._todo:
                step = self._todo[0]
                self._say(f"{self._name(step)}: {step.instruction}")
                word = "" if auto else ask(f"  {KEYS} >")
                if word == "q":
                    return 0
                if word == "s":
                    self._skipped.add(step.number)
                    self._todo.popleft()
                elif word == "r":
                    self._redo_last()
                elif word:
                    self._say(f"  {word!r} is not one of the keys")
                elif not self._captured(step) and auto:
                    return 1
        finally:
            with suppress(TipforceError):  # if the node is lost, the first error is reported
                for entry, value in zip(_LOAD, before, strict=False):
                    sdo.write(entry, value)
        if self._skipped:
            self._say(f"{len(self._skipped)} steps were skipped; the same command asks for them again")
        return None

    def _redo_last(self) -> None:
        number = self._session.drop_last()
        if number is None:
            self._say("  there is no capture to repeat")
            return
        step = next((step for step in self._steps if step.number == number), EXTRA_TARE)
        self._say(f"  {self._name(step)} is removed from {self._session.path}")
        self._todo.appendleft(step)

    def _say_where(self) -> None:
        steps = f"{len(self._session.done)} of {len(self._steps)} steps are in {self._session.path}"
        self._say(f"{steps}; the same command continues there" if self._session.rows else "nothing was captured")

    def _captured(self, step: Step) -> bool:
        """Capture until the result is good: with --auto a limited number of times, otherwise the user decides."""
        for _ in range(_AUTO_TRIES if self._args.auto else 1):
            try:
                for entry, value in zip(_LOAD, step.load[:3], strict=True) if self._args.auto else ():
                    self._client.sdo.write(entry, value)
                with common.progress("  capture", self._args.samples, absolute=True) as advance:
                    capture = self._reader.capture(self._args.samples, advance)
            except NoResponseError as error:
                if self._args.auto:
                    raise
                self._say(f"  no capture: {error}")
                return False
            reasons = refusals(capture, self._args.max_std, self._args.max_drift)
            if not reasons:
                self._take(step, capture)
                return True
            self._say("\n".join(f"  refused: {reason}" for reason in reasons))
        return False

    def _take(self, step: Step, capture: Capture) -> None:
        remark = self._remark(step, capture)
        self._session.append(step, capture)
        self._todo.popleft()
        self._skipped.discard(step.number)
        if common.OUTPUT.json:
            number, (P_N, phi_deg, theta_deg) = step.number if step.number != EXTRA else "extra", step.load[:3]
            gauges = {f"{name}_microstrain": getattr(capture, name).tolist() for name in ("mean", "std", "drift")}
            common.print_json({
                "step": number, "steps": len(self._steps), "P_N": P_N, "phi_deg": phi_deg, "theta_deg": theta_deg,
                "mode": step.mode, "samples": capture.count, **gauges, "temperature_degC": capture.temperature_degC,
            })  # fmt: skip
        for k, (mean, std, drift) in enumerate(zip(capture.mean, capture.std, capture.drift, strict=True)):
            common.note(f"  SG{k + 1} {mean:+10.2f} microstrain, standard deviation {std:.2f}, drift {drift:+.2f}")
        common.note(f"  {capture.count} samples in {capture.duration_s:.2f} s: saved")
        if remark:
            self._say(f"  note: {remark} (r repeats it)")

    def _remark(self, step: Step, capture: Capture) -> str:
        """Return a remark on a weight that was probably not applied or not removed."""
        tares = [row.mean_microstrain for row in self._session.rows if row.unloaded]
        if not tares:
            return ""
        moved = float(np.abs(capture.mean - tares[-1]).max())
        if step.mode != "tare":
            u = float((capture.std / np.sqrt(capture.count)).max())
            unmoved = moved < max(_UNMOVED_MICROSTRAIN, 5.0 * u)
            return "same reading as the last unloaded one: is the weight applied?" if unmoved else ""
        loaded = [np.abs(row.mean_microstrain - tares[-1]).max() for row in self._session.rows if not row.unloaded]
        remark = f"{moved:.1f} microstrain from the last unloaded reading: is a load still applied?"
        return remark if loaded and moved > _MOVED_SHARE * max(loaded) else ""

    def _name(self, step: Step) -> str:
        return "the extra unloaded reading" if step.number == EXTRA else f"step {step.number} of {len(self._steps)}"

    def _say(self, text: str) -> None:
        """Print a line for the user; with -q only if prompts follow, which need it."""
        if not (common.OUTPUT.quiet and self._args.auto):
            print(text, file=sys.stderr)

    def _finish(self) -> bool:
        """Fit the session, show it, write the file, apply and store it after confirmation; True: redo the last step."""
        args, path = self._args, str(self._session.path)
        data = replace(read_measurements(path, loads=True), ignored_columns=())  # the guide's own columns
        result = fitted(self._request, data, common.note)
        C, A = result.fit.C, result.fit.A
        # The residuals also contain differences between hooks; the scatter of a single reading of the node is that
        # within the captures. C is then optimal for that noise, which matters for a node with more than three gauges.
        covariance, dof = self._session.noise()
        noise = to_digits(covariance)
        calibration = replace(
            result.calibration,
            C=matrix_to_digits(weighted_inverse(A, noise)) if len(A) > 3 else C,
            covariance_strain2=to_digits(noise * variance_factors(dof, len(A) - 3)[0]),
            redundancy_limit=limit_of(result.fit, noise, dof, result.calibration.calibrated_force_newtons),
        )
        result = result._replace(calibration=calibration)
        notes = ["the node gets the noise covariance within the captures"]
        if result.fit.outliers:
            notes.append("to repeat an outlier: remove its line from the session and start the same command")
        publish(path, result, notes)
        if args.output:  # first, so that a later failure does not lose it
            write(args.output, path, result)
        name = common.shown_node(args.node)
        answer = self._asked(f"{name}: apply this calibration and store it")
        if answer in ("y", "yes"):
            fit.transfer(self._client, calibration, True, "applied and stored")
        elif answer != "r":
            common.note(f"{name} is unchanged; the same command asks again")
        return answer == "r"

    def _asked(self, question: str) -> str:
        if self._args.auto:
            bus_flags.confirm(self._args, question)
        if self._args.auto or self._args.yes:
            return "yes"
        allowed = ("y", "yes", "r", "", "n", "no", "q")
        while (word := ask(f"{question}? y: yes, r: redo the last step, Enter: no >")) not in allowed:
            pass
        return word
