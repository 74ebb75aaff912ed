"""Baselines without learning, evaluated behind the same shield, and their tables.

First come the rungs behind a shield for the whole set of brakes, then those behind one that follows the running
estimate (:mod:`emb_train.structured.adaptive_shield`). All rungs meet the same brakes with the same noise, so that
differences are sharper than means.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from emb_bench.information.symmetric import Floats
from emb_bench.numbers import Score
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, BrakeParameters
from emb_runtime.config.plants import THESIS_PLANT
from emb_runtime.config.shield_config import shield_config
from emb_runtime.learning.law import law_between
from emb_runtime.safety.sensor_monitor import CONFIRMED
from emb_runtime.safety.shield_design import ShieldLaw
from emb_runtime.system.realtime import processors
from emb_train.envs.excitations import Played
from emb_train.envs.measure import mean_score
from emb_train.envs.play import Draw, Outcome, middle_of, play
from emb_train.evaluation.known_optimum import KnownOptimum, OptimumTask, best_currents, default_path, plant_of
from emb_train.names import reference_names
from emb_train.structured.adaptive_shield import SHIELDS, can_follow, narrowest
from emb_train.structured.estimator import COVARIANCE, PARAMETERS
from emb_train.structured.law import TERMS, no_loop
from emb_train.structured.stored import FORMS, Form, Stored, stored
from emb_train.structured.task import Task, around
from emb_train.structured.trial import ANY_PRECISION, ReportedOutcome

CONSTANTS = (1.0, 0.5, -0.5, -1.0)  # Constant currents, as shares of the limit
FOLDER = Path(__file__).with_name("references")
"""References that only this study plays: further seeds, controls, and those for a set that no bench's shield covers."""
CONTROL = "-blind-control"  # Ending of the names of blind references that were searched for as long as an adaptive one
KNOWN = 0.002  # Half-width of the set that an oracle's shield covers around each brake, relative


@dataclass(frozen=True, eq=False)
class Rung:
    """One excitation on the brakes of an evaluation."""

    name: str
    values: Floats  # The criterion of each experiment, shape [N]
    violations: int  # Experiments that left the limits
    home: int  # Experiments that ended at home
    angle: float  # Farthest from the origin at the end [rad]
    velocity: float  # Fastest at the end [rad/s]
    mistaken: int | None
    """Experiments in which the true brake was ever outside the set of the shield; None for one that knows the set."""
    known: str = ""
    """95 % of the times until a precision, and of the true errors at that moment; empty where none is asked for."""

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
        int(outcome.mistaken.sum()) if isinstance(outcome, ReportedOutcome) and task.shield != SHIELDS[0] else None,
    )


def ladder(task: Task, bench: Bench, draws: list[Draw], *, designed: bool = True) -> list[Rung]:
    """All rungs: constant current, nominal optimal input, and what is stored for this task, for either shield.

    For a set that a bench's own shield does not cover there is no nominal optimal input: the environment refuses it.
    Where the filter does not know the plant there is no shield that follows the estimate.

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
    if designed and not task.share:
        found.append(nominal_design(task, bench, draws))
    for behind in shields_of(task, bench):
        found += [follow(name, behind, bench, draws) for name in references_of(behind)]
    return found


def shields_of(task: Task, bench: Bench) -> list[Task]:
    """The task behind each shield that there is for it on this bench."""
    applied = task.conditions.applied(task.on(bench))
    follows = can_follow(applied, bench.plant(task.plant), task.conditions.randomised)
    return [replace(task, shield=shield) for shield in SHIELDS if shield == "worst case" or follows]


def references_of(task: Task) -> list[str]:
    """Names of the stored references that were tuned for a task: currents, speeds, then those that adapt.

    Behind the task's shield, on its plant or on the thesis's.
    """
    every = (*reference_names(), *(path.stem for path in FOLDER.glob("*.json")))
    kept = {name: reference(name) for name in every}
    asked = (task.name, task.shield)
    names = [n for n, k in kept.items() if (k.task, k.shield) == asked and k.plant in (THESIS_PLANT, task.plant)]
    return sorted(names, key=lambda name: (FORMS.index(kept[name].form), name))


def reference(name: str) -> Stored:
    """Returns a reference by its name: one of this study, or of the package.

    Raises:
        UsageError: there is none of that name.
    """
    path = FOLDER / f"{name}.json"
    return stored(str(path) if path.exists() else name)


def follow(name: str, task: Task, bench: Bench, draws: list[Draw], first_move: bool = True) -> Rung:
    """A stored reference, with a first move or as if the polarity were known from the start."""
    outcome = follow_all(reference(name), task, bench, draws, first_move=first_move)
    found = rung(name, task, outcome)
    if task.precision == ANY_PRECISION:
        return found
    nominal = np.array([getattr(bench.brake, n) for n in PARAMETER_NAMES])
    truth = np.array([[getattr(draw.brake, n) for n in PARAMETER_NAMES] for draw in draws]) / nominal
    errors = np.abs(outcome.estimates[:, PARAMETERS:COVARIANCE] / truth - 1.0)
    shares = ", ".join(f"{n} {q:.2%}" for n, q in zip(PARAMETER_NAMES, np.quantile(errors, 0.95, axis=0), strict=True))
    return replace(
        found, known=f"95 % of the times {np.quantile(outcome.known, 0.95):.4f} s, of the true errors {shares}"
    )


def follow_all(
    kept: Stored,
    task: Task,
    bench: Bench,
    draws: list[Draw],
    laws: Sequence[ShieldLaw] | None = None,
    first_move: bool = True,
) -> ReportedOutcome:
    """Plays a reference on the brakes; ``laws`` as in :meth:`emb_train.structured.trial.Trials.play`."""
    trials = task.trials(bench, draws)
    if not first_move:
        trials.experiments.monitor[:, CONFIRMED] = 1.0
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
    currents = best_currents(OptimumTask(bench.text, task.plant, task.criterion, task.parameters, middle))
    ranges = bench.range_set(task.ranges)
    outcome = play(bench, ranges, task.parameters, Played(currents), draws, task.plant, task.conditions)
    return rung("nominal optimal input", task, outcome)


def optima(task: Task, bench: Bench, draws: Sequence[Draw]) -> Floats:
    """The criterion of each brake's own optimal input, were the brake known: no noise, delay or shield, shape [N].

    Searched for, which takes up to a minute for a brake, and kept in the user's cache.
    """
    on, middle = plant_of(bench.plant(task.plant)), middle_of(task.on(bench).range_set(task.ranges))
    known = KnownOptimum(bench, task.measure, task.parameters, default_path())
    return known.optima(on or task.plant, middle, [draw.brake for draw in draws], len(processors()), lambda line: None)


def beside(task: Task, rungs: Sequence[Rung], optimum: Floats) -> str:
    """The mean share of each brake's optimum as text, on the first brakes of an evaluation; of D the difference."""
    against = "nat beyond" if task.measure.against == "difference" else "of"
    lines = [f"beside the optimum of each of {len(optimum)} brakes, as if it were known:"]
    for r in rungs:
        share = mean_score(task.measure.shares(r.values[: len(optimum)], optimum))
        lines.append(f"{r.name}: {share.value:.4f} ± {_width(share):.2g} {against} it")
    return "\n".join(lines)


def oracle_laws(bench: Bench, brakes: Sequence[BrakeParameters]) -> list[ShieldLaw]:
    """The shield of each brake if its parameters were known to ±0.2 %: what no bench knows beforehand.

    Args:
        bench: with what the shield has to cover beside the brakes, see
        :meth:`emb_train.envs.conditions.Conditions.applied`.
        brakes: true parameters.
    """
    setting, sets = shield_config(bench), (around(brake, KNOWN, "known") for brake in brakes)
    return [law_between(setting, s.low, s.high, setting.angle_noise, setting.velocity_noise) for s in sets]


def tuned_for(task: Task, form: Form) -> list[str]:
    """Names of the references of a form that were tuned for the task on its own plant, delays and shield."""
    kept = [(name, reference(name)) for name in references_of(task)]
    asked = (form, task.plant, task.command_delay)
    return [name for name, k in kept if (k.form, k.plant, k.command_delay) == asked]


def over_seeds(task: Task, rungs: Sequence[Rung]) -> list[float]:
    """Means of what adapts to the estimate and was tuned for this very task, one for each seed of its search."""
    names = tuned_for(task, "affine")
    return [r.mean.value for r in rungs if r.name in names]


def blind_of(task: Task) -> str:
    """Name of the blind speed sequence that was tuned for this very task; empty if none was."""
    return next((name for name in tuned_for(task, "speed") if not name.endswith(CONTROL)), "")


def table(task: Task, bench: Bench, rungs: Sequence[Rung], base: str = "") -> str:
    """The ladder as text, with the differences to the rung ``base``.

    That is the blind speed sequence that was tuned for this task, where there is one and no other name is given.

    Brakes that are drawn have an interval for their mean; those of a grid are no sample, and have none.

    Raises:
        BenchFileError: the shield cannot guarantee the limits for the task's set.
    """
    base = base or blind_of(task)
    blind = next((r for r in rungs if r.name == base), None)
    count, farthest = len(rungs[0].values), bench.limits.angle[1]
    covered = narrowest(task.conditions.applied(task.on(bench)))[0].limits.angle[1]
    upto = f" up to {covered:.1f} of {farthest:g} rad" if covered < farthest else ""
    about = f"{task.name}: {task.summary}; {task.label}"
    lines = [f"{about}; {count} brakes, shield '{task.shield_ranges}'{upto}, {task.plant}"]
    head = f"{'':42}{'mean':>12}{'95 %':>12}{'beyond base':>14}{'95 %':>11}{'violations':>12}{'home':>7}"
    lines.append(head + f"{'end rad':>9}{'rad/s':>7}{'mistaken':>10}")
    for r in rungs:
        mean = r.mean
        beyond, wide = "-", "-"
        if blind is not None and blind is not r:
            score = r.beyond(blind)
            beyond, wide = f"{score.value:.3g}", _half(task, score, 2)
        lines.append(
            f"{r.name:42}{mean.value:12.6g}{_half(task, mean, 3):>12}{beyond:>14}{wide:>11}{r.violations:12}{r.home:7}"
            f"{r.angle:9.3f}{r.velocity:7.2f}{'-' if r.mistaken is None else r.mistaken:>10}"
        )
    lines += [f"{r.name}: {r.known}" for r in rungs if r.known]
    for behind in shields_of(task, bench):
        seeds = over_seeds(behind, rungs)
        if len(seeds) > 1:
            score = mean_score(np.array(seeds))
            found = f"{score.value:.6g}, 95 % {score.low:.6g}..{score.high:.6g}"
            lines.append(f"affine, {behind.shield}, {len(seeds)} seeds of the search: {found}")
    return "\n".join(lines)


def _half(task: Task, score: Score, digits: int) -> str:
    """Half of the interval of a mean over drawn brakes."""
    half = _width(score)
    return f"{half:.{digits}g}" if task.count and math.isfinite(half) else "-"


def _width(score: Score) -> float:
    return 0.5 * (score.high - score.low)
