"""The end of a guided calibration: the fit, its report, and after confirmation the transfer to the node."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Literal

from tipforce.host.configuration.measurements import read_measurements
from tipforce.host.network.finger import FingertipClient
from tipforce.sensor.calibration.distributions import variance_factors
from tipforce.sensor.calibration.result import matrix_to_digits, to_digits
from tipforce.sensor.calibration.statistics import left_inverse
from tipforce_tools.calibrate.fitting import FitRequest, fitted, limit_of, publish, write
from tipforce_tools.calibrate.guide_session import Session
from tipforce_tools.calibrate.guide_walk import ask
from tipforce_tools.cli import common

Answer = Literal["applied", "declined", "redo"]


def finish(args: argparse.Namespace, request: FitRequest, session: Session, client: FingertipClient) -> Answer:
    """Fit the session, show it, write the file, and after confirmation apply, verify and store it.

    Raises InputError if the rows do not determine a calibration, RefusedError if the node refuses it.
    """
    path = str(session.path)
    data = replace(read_measurements(path, loads=True), ignored_columns=())  # the guide's own columns
    result = fitted(request, data, lambda text: common.note(args, text))
    fit = result.fit
    # The residuals also contain differences between hooks; the scatter of a single reading of the node is that within
    # the captures. C is then optimal for that noise, which matters for a node with more than three gauges.
    noise, dof = to_digits(session.noise_covariance_strain2()), session.freedom()
    calibration = replace(
        result.calibration,
        C=matrix_to_digits(left_inverse(fit.A, noise)) if fit.C.shape[1] > 3 else fit.C,
        covariance_strain2=to_digits(noise * variance_factors(dof, fit.C.shape[1] - 3)[0]),
        redundancy_limit=limit_of(fit, noise, dof, result.calibration.calibrated_force_newtons),
    )
    result = result._replace(calibration=calibration)
    repeat = ("to repeat an outlier: remove its line from the session and start the same command",) * bool(fit.outliers)
    publish(args, path, request, result, ("the node gets the noise covariance within the captures", *repeat))
    if args.output:  # first, so that a later failure does not lose it
        write(args, path, request, result)
    name = f"node {common.shown_id(args.node)}"
    answer = _asked(args, f"{name}: apply this calibration and store it")
    if answer == "declined":
        common.note(args, f"{name} is unchanged; the same command asks again")
    if answer != "applied":
        return answer
    generation = client.apply_calibration(calibration, on_step=lambda step: common.note(args, f"{name}: {step}"))
    crc32 = f"0x{calibration.crc32():08X}"
    record = {"node": args.node, "generation": generation, "crc32": crc32}
    common.print_record(args, record, f"applied and stored, generation {generation}, CRC-32 {crc32}")
    return answer


def _asked(args: argparse.Namespace, question: str) -> Answer:
    if args.auto:
        common.confirm(args, question)
        return "applied"
    if args.yes:
        return "applied"
    while True:
        word = ask(f"{question}? y: yes, r: redo the last step, Enter: no >")
        answers: dict[str, Answer] = {"y": "applied", "yes": "applied", "r": "redo", "": "declined", "n": "declined",
                                      "no": "declined", "q": "declined"}  # fmt: skip
        if word in answers:
            return answers[word]
