"""Sentences on a record and on its Fisher information; base install only."""

from __future__ import annotations

import math
from collections.abc import Collection

from emb_bench.brake.parameters import UNITS
from emb_bench.experiment.experiment import Experiment, Lack
from emb_bench.information.evaluation import Evaluation
from emb_bench.information.identifiability import Border, Direction, Doubt, Finding, Identifiability, combination
from emb_bench.numbers import in_samples
from emb_runtime.numbers import plain

DOUBTS = {
    Doubt.NO_INFORMATION: "no effect on the record",
    Doubt.ONLY_COMBINED: "only in combination with others",
    Doubt.NOTHING_NEW: "the record adds nothing to the prior",
    Doubt.TOO_WIDE: "the best possible interval is as large as the value or a gross error",
    Doubt.FLAT: "no value within the search is excluded",
    Doubt.OPEN_BELOW: "only values above the interval are excluded",
    Doubt.OPEN_ABOVE: "only values below the interval are excluded",
    Doubt.CUT: "the interval ends where another parameter is at the border of its search",
    Doubt.AT_BORDER: "the value is AT THE BORDER of the search",
    Doubt.CONTAINS_ZERO: "the interval contains zero",
}
"""Reasons that a parameter is not identified."""

BORDERS = {
    Border.BELOW: "outside its range, beyond the lower border",
    Border.AT_LOWER: "at the lower border of its range",
    Border.AT_UPPER: "at the upper border of its range",
    Border.ABOVE: "outside its range, beyond the upper border",
}
"""Places of a value at, or beyond, a border of its range."""

LACKS = {
    Lack.ENDS_EARLY: "the experiment ends after {} of {} samples",
    Lack.LOST: "{} samples were lost: they have no information, and the currents of the periods before them were not "
    "reported",
    Lack.LOST_WITH_CHARGE: "{} samples were lost: they have no information, and the currents of the periods before "
    "them were not reported; the charge gives them for {} periods",
    Lack.CONTRADICTED: "in {} periods the node reports another current than that of the command",
    Lack.NO_COUNTERS: "the recording has no counters, answers or states: repeated, late or lost commands do not show",
    Lack.NO_VELOCITY: "the recording has no velocity: an observer ({:g} rad/s) derives one from the angles, which has "
    "no weight in an estimate",
    Lack.NO_CURRENT: "the recording has no measured current: the applied current is assumed to be the commanded one",
    Lack.NO_COMMANDS: "no commands in the recording: the applied current is the mean measured one of each period",
    Lack.NO_TIMES: "the recording has no times: its rows are assumed to be one sample time apart",
    Lack.LOST_OF_RECORDING: "{} samples are lost: the currents of the periods before them are uncertain",
    Lack.HEAD: "line {} of the file is its head; the lines before it are skipped",
    Lack.OTHER_FRAMES: "{} frames were skipped, of {} identifiers that the map does not name",
    Lack.BAD_FRAMES: "{} frames do not fit the DBC and were skipped",
}
"""Parts of an experiment that are missing, with places for their numbers."""


def lacks(x: Experiment, but: Collection[Lack] = ()) -> list[str]:
    """Missing or uncertain parts of an experiment."""
    return [LACKS[lack].format(*numbers) for lack, numbers in x.quality.lacks.items() if lack not in but]


def assumed_currents(x: Experiment) -> list[str]:
    """Assumptions about the applied currents that are not the reported ones."""
    q = x.quality
    if q.within is None:
        return []
    if math.isnan(q.within):
        return ["the drive's mapping is not readable: the applied currents are assumed to be the reported ones"]
    return [
        f"the applied current is assumed to be the command on the bus, {in_samples(q.command_delay)} late, if "
        f"the drive reports one within {q.within:.3g} A of it, else the reported one"
    ]


def doubts(f: Finding) -> str:
    """Reasons that a parameter is not identified; empty if it is."""
    return "; ".join(DOUBTS[doubt] for doubt in f.doubts)


def trade_offs(f: Finding) -> str:
    """Parameters with which it trades off, with the correlations; empty without any."""
    others = ", ".join(f"{name} (correlation {plain(correlation, 4)})" for name, correlation in f.traded_with.items())
    return f"trades off with {others}" if others else ""


def finding(f: Finding) -> str:
    """Identifiability of one parameter."""
    verdict = "identified" if f.identified else f"NOT identified: {doubts(f)}"
    border = "" if f.border is None else BORDERS[f.border]
    return "; ".join(filter(None, (verdict, trade_offs(f), border)))


def direction(d: Direction) -> str:
    """A combination of parameters that the data do not identify."""
    if math.isinf(d.deviation):
        return f"no information on {combination(d.shares)}"
    return f"hardly any information on {combination(d.shares)}: known to {plain(d.deviation)} times its size"


def directions(found: Identifiability) -> list[str]:
    """Combinations that are not identified, or by the prior alone."""
    lines = [direction(d) for d in found.directions]
    return lines + [f"from the prior alone: {combination(shares)}" for shares in found.left_to_prior]


def warnings(e: Evaluation) -> list[str]:
    """Reasons to doubt an information."""
    found = [text for text in (e.log.missing, *lacks(e.experiment)) if text]
    late, expected = e.experiment.quality.command_delay, e.plant.instruments.command_delay
    if late != expected:
        found.append(
            f"commands acted {in_samples(late)} late, in the model '{e.plant.name}' {in_samples(expected)}: the "
            "currents are those of the log"
        )
    if e.absent:
        found.append(
            f"{', '.join(e.absent)} is zero in the model '{e.plant.name}', which has no sensitivity to it; use a model "
            "that has it"
        )
    if e.fit.fits:
        return found
    if e.log.is_recording:
        why = (
            "theta is a guess of the map: pass --theta with an estimate"
            if e.theta_name == "nominal"
            else "the model lacks a disturbance of the machine"
        )
    elif e.log.missing or e.experiment.quality.lacks:
        why = "with missing data theta cannot be tested"
    else:
        why = "pass --theta or --model"
    worst = max(e.fit.compared)
    return [
        *found,
        f"model '{e.plant.name}' with theta of '{e.theta_name}' does not fit (rms {plain(worst)} sigma): {why}",
    ]


def notes(e: Evaluation) -> list[str]:
    """Assumptions about the currents that acted, and effects of the model's instruments."""
    instruments, found = e.plant.instruments, assumed_currents(e.experiment)
    if given := {name: value for name, value in e.errors._asdict().items() if value}:
        values = ", ".join(f"{n} = {plain(v)} {UNITS[n]}".removesuffix(" 1") for n, v in given.items())
        found.append(f"systematic errors of this record are fixed at those of {e.theta_name}: {values}")
    if instruments.observer_bandwidth > 0.0:
        found.append("the velocity comes from an observer and adds no physical information")
    if instruments.clock_jitter > 0.0:
        found.append(
            "a sigma includes the motion during the clock's jitter; angle and velocity of a sample count as "
            "independent, so bounds are right to a percent up to 20 µs"
        )
    if instruments.measurement_delay > 0:
        found.append(f"samples show the brake {in_samples(instruments.measurement_delay)} earlier")
    if instruments.encoder_offset != 0.0 and e.errors.offset is None:
        found.append(f"the encoder is assumed to show {instruments.encoder_offset:g} rad at the origin")
    return found
