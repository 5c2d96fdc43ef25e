"""The end of a guided calibration: the fit, its report, and after confirmation the transfer to the node."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Literal

from tipforce.errors import InputError
from tipforce.host.configuration.calibration_file import fit_record, write_calibration
from tipforce.host.configuration.measurements import read_measurements
from tipforce.host.network.finger import FingertipClient
from tipforce.sensor.calibration.distributions import variance_factors
from tipforce.sensor.calibration.rounding import matrix_to_digits, to_digits
from tipforce.sensor.calibration.statistics import left_inverse
from tipforce_tools.calibrate import fit as fit_command
from tipforce_tools.calibrate import fit_report
from tipforce_tools.calibrate.fit_checks import limit_of
from tipforce_tools.calibrate.guide_session import Session
from tipforce_tools.calibrate.guide_walk import ask
from tipforce_tools.cli import common
from tipforce_tools.cli.layout_file import read_layout

Answer = Literal["applied", "declined", "redo"]


def check_model(args: argparse.Namespace, gauges: int) -> None:
    """Raise InputError for wrong flags of the fit, before an hour of weights."""
    if args.layout and len(read_layout(args.layout)[1]) != gauges:
        raise InputError(f"--layout {args.layout} has {len(read_layout(args.layout)[1])} gauges, the node has {gauges}")
    fit_command.model_of(args)


def finish(args: argparse.Namespace, session: Session, client: FingertipClient) -> Answer:
    """Fit the session, show it, write the file, and after confirmation apply, verify and store it.

    Raises InputError if the rows do not determine a calibration, RefusedError if the node refuses it.
    """
    path = str(session.path)
    data = replace(read_measurements(path, loads=True), ignored_columns=())  # the guide's own columns
    fit, model, scores = fit_command.fit_of(args, data)
    # The residuals also contain differences between hooks; the scatter of a single reading of the node is that within
    # the captures. C is then optimal for that noise, which matters for a node with more than three gauges.
    noise = to_digits(session.noise_covariance_strain2())
    C = matrix_to_digits(left_inverse(fit.A, noise)) if fit.C.shape[1] > 3 else fit.C
    calibration = fit_command.calibration_of(args, data, fit)
    dof = session.freedom()
    limit = limit_of(fit, noise, dof, calibration.calibrated_force_newtons)
    wider = to_digits(noise * variance_factors(dof, fit.C.shape[1] - 3)[0])
    calibration = replace(calibration, C=C, covariance_strain2=wider, redundancy_limit=limit)
    notes = fit_report.notes(data, fit, model, args.layout, calibration, scores)
    warnings = fit_report.warnings(fit_command.readings_of(data), fit)
    notes.append("the node gets the noise covariance within the captures")
    if fit.outliers:
        notes.append("to repeat an outlier: remove its line from the session and start the same command")
    if args.json:
        fit_report.print_json(path, data, fit, calibration, notes, warnings)
    else:
        fit_report.print_text(path, data, fit, model, notes)
    for warning in warnings:
        common.note(args, f"{path}: {warning}")
    name = f"node {common.shown_id(args.node)}"
    if args.output:  # first, so that a later failure does not lose it
        facts = fit_report.facts(path, data, fit) | {"angle_scatter_deg": args.angle_scatter}
        write_calibration(args.output, calibration, fit_record(fit, **facts))
        common.note(args, f"{args.output}: written, load sense {'pull' if calibration.pull else 'push'}")
    answer = _asked(args, f"{name}: apply this calibration and store it")
    if answer == "declined":
        common.note(args, f"{name} is unchanged; the same command asks again")
    if answer != "applied":
        return answer
    generation = client.apply_calibration(calibration, on_step=lambda step: common.note(args, f"{name}: {step}"))
    if args.json:
        common.print_json({"node": args.node, "generation": generation, "crc32": f"0x{calibration.crc32():08X}"})
    else:
        print(f"applied and stored, generation {generation}, CRC-32 0x{calibration.crc32():08X}")
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
