"""The main path in Python: run in simulation, open a log, Fisher information, estimate, design.

Each function does what the command of that name does with the same options, and returns the record that the command
prints: :func:`simulate` is ``emb-run --iface sim``, :func:`fisher_information` is ``emb-replay fim``, :func:`estimate`
is ``emb-replay estimate``, :func:`design` is ``emb-design``, :func:`topic` and :func:`draw` are
``emb-replay export``. All values are in SI units.

    from emb_bench import api

    run = api.simulate("run.mcap", parameters={"f_v": 3e-5})
    print(api.fisher_information(run).fisher("physical").cramer_rao())
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

from emb_bench.design.problem import COARSE_SEARCHES, make_problem
from emb_bench.estimate.records import STARTS, EstimationProblem
from emb_bench.experiment.evaluation import Evaluation, Question, bench_for, default_model, evaluate
from emb_bench.experiment.from_log import read_experiment
from emb_bench.export.picture import draw_on
from emb_bench.export.tables import arrow_batches
from emb_bench.information.criteria import Name, criterion
from emb_bench.information.fisher import Kind
from emb_bench.logs.log import RunLog, read_log, require_driven
from emb_bench.sim.plant_spec import true_parameters
from emb_runtime.cli.options import parser, prepare
from emb_runtime.cli.repeat import experiment
from emb_runtime.cli.session import Console
from emb_runtime.config.bench import PARAMETER_NAMES, load_bench
from emb_runtime.config.plants import DEFAULT_PLANT
from emb_runtime.errors import UsageError

if TYPE_CHECKING:  # scipy and numba come with the extra [bench]
    from matplotlib.axes import Axes
    from pyarrow import Table

    from emb_bench.analysis.study import Study
    from emb_bench.design.report import Report

Run = RunLog  # An opened log


def simulate(
    log: str | Path,
    *,
    plant: str = DEFAULT_PLANT,
    parameters: Mapping[str, float] | None = None,
    seed: int = 1,
    policy: str | Path | None = None,
    quick: bool = False,
    bench: str | Path | None = None,
    duration: float | None = None,
) -> Run:
    """Run one experiment on the simulated bench, behind the same shield and guard as on a real one.

    Args:
        log: MCAP file to write; must not exist.
        plant: name of one of the bench's plants.
        parameters: true parameters by name [SI]; those that are not named are nominal.
        seed: of the sensors' noise.
        policy: ONNX file; without, the shipped actor.
        quick: the shipped actor for a short experiment, until all four parameters are known to about 1 %.
        bench: bench file; without, the shipped one.
        duration: of the experiment [s]; without, the policy's horizon.

    Returns:
        The run, opened; :attr:`~emb_bench.logs.log.RunLog.exit_reason` says how it ended.

    Raises:
        EmbError: an argument is wrong, the policy does not fit the bench, or the log cannot be written.
    """
    options = {"plant": plant, "seed": seed, **(parameters or {})}
    iface = "sim:" + ",".join(f"{name}={value}" for name, value in options.items())
    arguments = ["--iface", iface, "--log", str(log)]
    for option, value in (("--policy", policy), ("--bench", bench), ("--duration", duration)):
        if value is not None:
            arguments += [option, str(value)]
    if quick:
        arguments.append("--quick")
    plan = prepare(parser().parse_args(arguments))
    unattended = Console(stop_requested=lambda: False, show=lambda *_: None, may_arm=lambda _: True)
    experiment(plan, plan.iface, Path(log), unattended)
    return open_run(log)


def open_run(log: str | Path) -> Run:
    """Open a log.

    Raises:
        UsageError: the file cannot be read.
        LogError: it is not a log, or too damaged.
    """
    return read_log(log)


def topic(run: Run, name: str) -> Table:
    """One topic of a run as an Arrow table; enumerated values are names, a value that does not exist is null.

    ``.to_pandas()`` makes a pandas frame of it, ``polars.from_arrow(...)`` one of polars, ``.column(name).to_numpy()``
    an array. ``run.counts`` has the names; ``run.tables[name]`` the plain columns without any further library.

    Args:
        run: the run.
        name: of the topic: ``/cycle``, ``/estimate``, ``/emb/EMB_ANGLE``, ...

    Raises:
        UsageError: the run has no such topic, or pyarrow is missing.
        LogError: the topic cannot be decoded.
    """
    schema, tables = arrow_batches(run, name)
    import pyarrow as pa

    parts = list(tables)
    return cast("Table", pa.concat_tables(parts) if parts else schema.empty_table())


def draw(run: Run, axes: Sequence[Axes]) -> None:
    """Draw a run on five axes of matplotlib: angle, velocity, currents, why currents were changed, states.

    Args:
        run: the run.
        axes: five, one above the other: ``plt.subplots(5, sharex=True)[1]``.

    Raises:
        UsageError: there are not five.
        LogError: the run has no control cycles.
    """
    draw_on(run, axes)


def fisher_information(
    run: Run,
    *,
    model: str | None = None,
    params: Sequence[str] = PARAMETER_NAMES,
    nuisances: Sequence[str] = (),
    prior: str | None = None,
    theta: Mapping[str, float] | None = None,
    bench: str | Path | None = None,
) -> Evaluation:
    """Both Fisher informations of a run.

    Args:
        run: the run.
        model: name of the plant to evaluate with; without, the one that was simulated, else ``exact``.
        params: unknown parameters that count; what is not named is known.
        nuisances: what is unknown besides.
        prior: name of the ranges in which the parameters were known to lie beforehand.
        theta: where to evaluate, by name [SI]; those that are not named are nominal.
        bench: bench file; without, the one inside the log.

    Returns:
        The evaluation: ``fisher("physical")`` and ``fisher("weighted")``, the fit of the model, and warnings.

    Raises:
        UsageError: a name is unknown, or the run only listened.
        LogError: the log says too little.
    """
    require_driven(run)
    its = bench_for(run, bench)
    question = Question(tuple(params), tuple(nuisances), None if prior is None else its.range_set(prior))
    plant = its.plant(default_model(run)[0] if model is None else model)
    given = {name: str(value) for name, value in (theta or {}).items()}
    name = ",".join(f"{n}={value}" for n, value in given.items()) or "nominal"
    brake = true_parameters(its, given) if given else its.brake
    return evaluate(run, read_experiment(run, its), its, plant, question, name, brake)


def estimate(
    runs: Run | Sequence[Run],
    *,
    params: Sequence[str] = PARAMETER_NAMES,
    nuisances: Sequence[str] = (),
    prior: str | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    model: str | None = None,
    method: str = "oem",
    starts: int = STARTS,
    seed: int = 0,
    profile: bool = False,
    bootstrap: int = 0,
    hold_out: Sequence[Run] = (),
    bench: str | Path | None = None,
    systematic: bool = True,
) -> Study:
    """Parameters of a brake from its runs, with uncertainties, and whether the model explains them.

    Args:
        runs: one run, or several of the same brake, which are taken together.
        params: parameters of interest; what is not named is known.
        nuisances: what is estimated besides.
        prior: name of ranges that were known beforehand.
        bounds: lowest and highest value to search, by name [SI].
        model: name of the plant; without, the one that was simulated, else ``exact``.
        method: ``oem``, ``pem`` or ``rls``.
        starts: local searches.
        seed: of the searches and the bootstrap.
        profile: add the likelihood profile of every parameter.
        bootstrap: draws of the bootstrap over runs.
        hold_out: runs that are predicted, not estimated from.
        bench: bench file; without, the one inside the first log.
        systematic: estimate the systematic errors along that the bench file does not exclude.

    Returns:
        The study; ``study.estimate.theta`` has the values, ``study.conclusions`` what is known of each parameter.

    Raises:
        UsageError: an argument is wrong, the runs do not go together, or scipy and numba are missing.
        LogError: a log says too little.
    """
    try:
        from emb_bench.analysis.study import StudyOptions, make_study
    except ImportError as err:
        raise UsageError("estimate needs scipy and numba: pip install 'emb-excite[bench]'") from err
    runs = [runs] if isinstance(runs, RunLog) else list(runs)
    if not runs:
        raise UsageError("expected at least one run")
    for run in (*runs, *hold_out):
        require_driven(run)
    its = runs[0].bench if bench is None else load_bench(bench, analysis=True)
    known = None if prior is None else its.range_set(prior)
    asked = EstimationProblem(tuple(params), tuple(nuisances), known, dict(bounds or {}))
    return make_study(
        its,
        runs,
        StudyOptions(asked, method, model, starts, seed, profile, bootstrap, systematic=systematic),
        held_out=hold_out,
    )


def design(
    name: Name = "D",
    *,
    params: Sequence[str] = PARAMETER_NAMES,
    of: Sequence[str] = (),
    theta: Mapping[str, float] | None = None,
    model: str = DEFAULT_PLANT,
    kind: Kind = "physical",
    returns: bool = True,
    starts: int = COARSE_SEARCHES,
    seed: int = 0,
    bench: str | Path | None = None,
) -> Report:
    """The current sequence that is optimal for known parameters, under the limits of the bench.

    Args:
        name: criterion: ``D``, ``A``, ``E`` or ``Ds``.
        params: unknown parameters.
        of: for ``Ds``, those of ``params`` that are wanted.
        theta: the brake's parameters by name [SI]; those that are not named are nominal.
        model: name of the plant.
        kind: which Fisher information.
        returns: whether the brake has to come home.
        starts: coarse searches.
        seed: of the random starts.
        bench: bench file; without, the shipped one.

    Returns:
        The report; ``report.found.best.currents`` are the currents [A], one per sample period.

    Raises:
        UsageError: an argument is wrong, no design was found, or scipy and numba are missing.
    """
    try:
        from emb_bench.design.report import make_report
    except ImportError as err:
        raise UsageError("design needs scipy and numba: pip install 'emb-excite[bench]'") from err
    its = load_bench(bench)
    goal = criterion(name, tuple(params), tuple(of))
    brake = true_parameters(its, {n: str(value) for n, value in (theta or {}).items()})
    problem = make_problem(its, goal, tuple(params), model=model, kind=kind, brake=brake, returns=returns)
    return make_report(its, problem, goal, kind, starts=starts, seed=seed)
