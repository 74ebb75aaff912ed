"""What needs no learning, rung by rung, into the same shield: what a learned excitation has to be measured against.

All rungs meet the same brakes with the same noise, so that differences are sharper than means.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from emb_bench.compare.scores import Score
from emb_bench.packed import Floats
from emb_runtime.bench import Bench, BrakeParameters, Ranges
from emb_runtime.envelope import ShieldLaw, make_law
from emb_train.evaluation.grid import middle_of
from emb_train.evaluation.measure import mean_score
from emb_train.evaluation.play import Draw, Outcome, play
from emb_train.evaluation.ruler import Task as Sought
from emb_train.evaluation.ruler import look_for
from emb_train.excitations import Played
from emb_train.structured.law import TERMS, no_loop
from emb_train.structured.stored import Stored, stored, stored_names
from emb_train.structured.task import Task

CONSTANTS = (1.0, 0.5, -0.5, -1.0)
"""Constant currents, as shares of the limit."""
KNOWN = 0.002
"""Of an oracle's set: how far a brake may be from what the shield knows of it, relative."""
ORACLE = "oracle"
"""Name of that set."""


@dataclass(frozen=True, eq=False)
class Rung:
    """One excitation on the brakes of an evaluation."""

    name: str
    values: Floats
    """The criterion of each experiment, shape [N]."""
    violations: int
    """Experiments that left the limits."""
    home: int
    """Experiments that ended at home."""
    angle: float
    """Farthest from the origin at the end [rad]."""
    velocity: float
    """Fastest at the end [rad/s]."""

    @property
    def mean(self) -> Score:
        """Mean with its interval over the draws."""
        return mean_score(self.values)

    def beyond(self, other: Rung) -> Score:
        """Mean of the differences to another rung on the same brakes."""
        return mean_score(self.values - other.values)


def rung(name: str, task: Task, outcome: Outcome) -> Rung:
    """An outcome as a rung."""
    return Rung(
        name,
        task.score(outcome),
        int(outcome.left.sum()),
        int(outcome.home.sum()),
        float(np.abs(outcome.angle).max()),
        float(np.abs(outcome.velocity).max()),
    )


def ladder(task: Task, bench: Bench, draws: list[Draw], *, designed: bool = True) -> list[Rung]:
    """All rungs: constant current, nominal optimal input, and what is stored for this task.

    Args:
        task: what counts.
        bench: limits, noise, timing.
        draws: brakes and noise.
        designed: whether to search for the nominal optimal input, which takes up to minutes.

    Raises:
        BenchFileError: the shield cannot guarantee the limits for the task's set.
        UsageError: the shield does not cover the brakes.
    """
    found = [constant(task, bench, draws)]
    if designed:
        found.append(nominal_design(task, bench, draws))
    return found + [follow(name, task, bench, draws) for name in references_of(task)]


def references_of(task: Task) -> list[str]:
    """Names of the stored references for a task: currents, speeds, then those that adapt."""
    names = {form: f"{task.name}-{form}" for form in ("current", "speed", "affine")}
    known = stored_names()
    others = [name for name in known if name.startswith(names["affine"] + "-")]
    return [name for name in (*names.values(), *others) if name in known]


def follow(name: str, task: Task, bench: Bench, draws: list[Draw]) -> Rung:
    """A stored reference."""
    kept = stored(name)
    return rung(name, task, follow_all(kept, task, bench, draws))


def follow_all(
    kept: Stored, task: Task, bench: Bench, draws: list[Draw], laws: Sequence[ShieldLaw] | None = None
) -> Outcome:
    """What a reference does on the brakes; ``laws`` as in :meth:`emb_train.structured.trial.Trials.play`."""
    trials = task.trials(bench, draws)
    (outcome,) = trials.play(kept.loop(trials.bench), kept.array()[None], laws)
    return outcome


def constant(task: Task, bench: Bench, draws: list[Draw]) -> Rung:
    """The best constant current, on these very brakes."""
    tables = np.zeros((len(CONSTANTS), 1, TERMS))
    tables[:, 0, 0] = CONSTANTS
    outcomes = task.trials(bench, draws).play(no_loop(bench), tables)
    rungs = [
        rung(f"constant {share * bench.limits.current:+g} A", task, outcome)
        for share, outcome in zip(CONSTANTS, outcomes, strict=True)
    ]
    return max(rungs, key=lambda r: r.mean.value)


def nominal_design(task: Task, bench: Bench, draws: list[Draw]) -> Rung:
    """The optimal input for the brake in the middle of the ranges, played as it is."""
    middle = middle_of(bench.range_set(task.ranges))
    currents = look_for(Sought(bench.text, task.plant, task.criterion, task.parameters, middle))
    ranges = bench.range_set(task.ranges)
    outcome = play(bench, ranges, task.parameters, Played(currents), draws, task.plant, task.conditions)
    return rung("nominal optimal input", task, outcome)


def oracle_laws(bench: Bench, brakes: Sequence[BrakeParameters]) -> list[ShieldLaw]:
    """The shield of each brake if its parameters were known to ±0.2 %: what no bench knows beforehand."""
    laws = []
    for brake in brakes:
        low, high = (
            brake._replace(k_m=share * brake.k_m, k_1=share * brake.k_1, T_c=share * brake.T_c, f_v=share * brake.f_v)
            for share in (1.0 - KNOWN, 1.0 + KNOWN)
        )
        known = replace(bench, ranges={**bench.ranges, ORACLE: Ranges(ORACLE, low, high)})
        laws.append(make_law(replace(known, shield=replace(known.shield, ranges=ORACLE))))
    return laws


def over_seeds(task: Task, rungs: Sequence[Rung]) -> list[float]:
    """Means of what adapts to the estimate, one for each seed of its search, behind the task's own shield."""
    names = [name for name in references_of(task) if name.startswith(f"{task.name}-affine")]
    return [r.mean.value for r in rungs if r.name in names]


def table(task: Task, rungs: Sequence[Rung]) -> str:
    """The ladder as text, with the differences to the blind speed sequence where there is one."""
    blind = next((r for r in rungs if r.name == f"{task.name}-speed"), None)
    count = len(rungs[0].values)
    lines = [f"{task.name}: {task.summary}; {task.measure.label}; {count} brakes, shield '{task.shield}', {task.plant}"]
    head = f"{'':42}{'mean':>12}{'95 %':>12}{'beyond blind':>14}{'95 %':>11}{'violations':>12}{'home':>7}"
    lines.append(head + f"{'end rad':>9}{'rad/s':>7}")
    for r in rungs:
        mean = r.mean
        other = (math.nan, math.nan)
        if blind is not None and blind is not r:
            score = r.beyond(blind)
            other = (score.value, 0.5 * (score.high - score.low))
        half = 0.5 * (mean.high - mean.low)
        lines.append(
            f"{r.name:42}{mean.value:12.6g}{half:12.3g}{other[0]:14.3g}{other[1]:11.2g}{r.violations:12}{r.home:7}"
            f"{r.angle:9.3f}{r.velocity:7.2f}"
        )
    seeds = over_seeds(task, rungs)
    if len(seeds) > 1:
        score = mean_score(np.array(seeds))
        lines.append(
            f"affine, {len(seeds)} seeds of the search: {score.value:.6g}, 95 % {score.low:.6g}..{score.high:.6g}"
        )
    return "\n".join(lines)
