"""Fisher information of runs and of currents, and the sensitivities behind it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emb_bench.analysis.options import MAP, Names, QuestionOptions
from emb_bench.api.arguments import AnyRun, driven, is_row, listed, options_of
from emb_bench.config.bench import load_bench
from emb_bench.config.plants import DEFAULT_PLANT
from emb_bench.experiment.experiment import planned
from emb_bench.options import option
from emb_runtime.errors import UsageError, needs

if TYPE_CHECKING:
    from emb_bench.estimate.expected import Interval
    from emb_bench.experiment.simulate import Trajectory
    from emb_bench.information.evaluation import Information


@dataclass(frozen=True, eq=False)
class FimOptions(QuestionOptions):
    """Options of a Fisher information."""

    params: Names | None = option(
        None,
        "parameters of interest; all others are fixed (default: the four of the brake; of a recording those "
        "that its map guesses)",
        "NAMES",
    )
    theta: str | Path | Mapping[str, float] | None = option(
        None,
        "where to evaluate: 'log' for the running estimate in the log, 'nominal', 'true' of a simulated brake, "
        "'name=value,...', or the JSON of an estimate or report (default: log, and nominal where it has no estimate)",
        "THETA",
    )
    map: str | Path | None = option(None, MAP, "FILE", kind=Path)
    plant: str | None = None  # The model, by the name that ``simulate`` has for it
    parameters: Mapping[str, float] | None = None  # The parameters, as ``simulate`` has them, in place of ``theta``

    def __post_init__(self) -> None:
        """Check all that needs no bench."""
        super().__post_init__()
        for name, one, other in (("model", self.model, self.plant), ("theta", self.theta, self.parameters)):
            if one is not None and other is not None:
                raise UsageError(f"{'plant' if name == 'model' else 'parameters'} is {name}: expected one of the two")


def fisher_information(
    run: AnyRun | Sequence[AnyRun] | Sequence[float] | Any = (), options: FimOptions | None = None, **more: Any
) -> Information:
    """Fisher information of a run: the smallest possible uncertainties of its parameters.

    Intervals are the Cramer-Rao bound for sensors with noise and without systematic errors: no method can do better.
    emb-replay estimate also estimates the systematic errors of the bench file, so its repeatability is larger. -v adds
    the criteria over time, and the information as the thesis weights it.

    Args:
        run: MCAP file of emb-run; with a map, a recording of others.
        options: a record of options.
        more: its fields as keywords: ``fisher_information(run, theta={"f_v": 3e-5})``.

    Returns:
        ``matrix``, ``covariance``, ``correlation`` and ``sensitivities`` of relative parameters; ``fisher("physical")``
        and ``fisher("weighted")``. Of one run also the fit of the model. In place of a run there may be several of one
        brake, whose informations add, or an array of planned currents [A], one per sample period, from rest at the
        origin.

    Raises:
        UsageError: a name is unknown, or the run only listened.
        LogError: the log has too little data.
    """
    from emb_bench.experiment.from_log import read_experiment
    from emb_bench.experiment.theta import read_theta
    from emb_bench.information.evaluation import bench_for, default_model, evaluate, expected, together

    settings = options_of("fisher_information", FimOptions, options, more)
    model, choice = settings.model or settings.plant, settings.parameters if settings.theta is None else settings.theta
    if is_row(run):
        its = load_bench(settings.bench, analysis=True)
        _, brake, errors = read_theta(choice, None, its)
        return expected(its, its.model(model or DEFAULT_PLANT), settings.question(its), brake, errors, run)
    found = []
    for entry in listed(run):
        log = driven(entry, settings.map)
        its = bench_for(log, settings.bench)
        question, its_plant = settings.question(its), its.model(model or default_model(log)[0])
        name, brake, errors = read_theta(choice, log, its)
        found += evaluate(log, read_experiment(log, its), its, [its_plant], question, name, brake, errors)
    if not found:
        raise UsageError("expected at least one run, or one current")
    return found[0] if len(found) == 1 else together(found)


def interval(information: Information) -> Interval:
    """The interval that an estimate will have: of the run or the currents of an information, with its unknowns.

    It has the unknowns of :func:`emb_bench.api.estimate`, the bench's systematic errors among them, and its budget.

    Args:
        information: what :func:`fisher_information` returned of one run, or of planned currents.

    Returns:
        ``repeatability``, ``between_runs`` and ``total``, standard deviations in the order of ``names``, relative or in
        the unknown's unit; ``largest(i)`` is the largest entry of the budget; ``of_comparison`` and
        ``of_repeatability`` are T and I [nat].

    Raises:
        UsageError: it is of several runs, the model cannot estimate the unknowns, or scipy and numba are missing.
        LogError: the record is too short for them.
    """
    with needs("the interval of an estimate", "bench"):
        from emb_bench.estimate.expected import of_information
    return of_information(information)


def sensitivities(
    currents: Sequence[float] | Any,
    *,
    params: Names | None = None,
    plant: str = DEFAULT_PLANT,
    parameters: Mapping[str, float] | None = None,
    bench: str | Path | None = None,
) -> Trajectory:
    """Motion of a brake under currents from rest at the origin, and its sensitivities to the parameters.

    Args:
        currents: one per sample period [A]; limits are not applied.
        params: names of the parameters (default: the four of the brake).
        plant: name of one of the bench's plants.
        parameters: parameters by name; the others are nominal.
        bench: bench file (default: the shipped one).

    Returns:
        ``states`` and ``samples`` (angle [rad], velocity [rad/s]) and ``sensitivities`` θ ∂y/∂θ of the n samples, shape
        (n, p, 2).

    Raises:
        UsageError: a name is unknown, or the currents are no row of finite numbers.
    """
    row = planned(currents).currents
    return fisher_information(row, params=params, plant=plant, parameters=parameters, bench=bench).trajectory
