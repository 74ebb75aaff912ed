"""The commands from Python: simulation, logs, information, estimate, report, campaign, design.

Each function is the command of that name, and its arguments are the command's options: :func:`simulate` is ``emb-run
--iface sim``, :func:`fisher_information` is ``emb-replay fim``, :func:`design` is ``emb-design``, the others are
``emb-replay``'s. A run is an opened log, or the path of one. Parameters are given as a sequence of names, or as one
name. All values are in SI units.

    from emb_bench import api

    run = api.simulate("run.mcap", parameters={"f_v": 3e-5})
    print(api.estimate(run, params="f_v"))
"""

from __future__ import annotations

import inspect
import math
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from emb_bench.config.bench import Bench, load_bench
from emb_bench.config.plants import DEFAULT_PLANT
from emb_bench.design.problem import COARSE_SEARCHES
from emb_bench.estimate.records import STARTS
from emb_bench.figures import for_notebook
from emb_bench.logs.log import RunLog, read_log, require_driven
from emb_bench.output import progress, replacing, require_place, say_if_compiling
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import LogError, UsageError, needs
from emb_runtime.estimator.estimate import NORMAL_95
from emb_runtime.system.terminal import as_json, mention

if TYPE_CHECKING:  # scipy, numba, matplotlib and pyarrow come with the extra [bench]
    from matplotlib.axes import Axes
    from pyarrow import Table

    from emb_bench.analysis.drift import Earlier
    from emb_bench.analysis.study import Study, StudyOptions
    from emb_bench.batch.summary import Campaign
    from emb_bench.design.report import Report
    from emb_bench.information.evaluation import Evaluation
    from emb_bench.report.content import Content
    from emb_bench.report.runs import RunTiming
    from emb_bench.rerun import Rerun

__all__ = [
    *("Run", "campaign", "design", "draw", "estimate", "export", "fisher_information", "info", "open_run"),
    *("report", "rerun", "simulate", "timing", "topic"),
]

Source = RunLog | str | Path
Names = str | Sequence[str]
PAGES = (".html", ".htm")  # Endings of a report's page
CYCLE = "/cycle"


class Run(RunLog):
    """An opened log, with what a notebook shows of it."""

    def __getitem__(self, topic: str) -> Mapping[str, Any]:
        """Columns of a topic as arrays, by name."""
        return self.tables[topic]

    def to_dataframe(self, name: str = CYCLE) -> Any:
        """One topic as a pandas frame, see :func:`topic`.

        Raises:
            UsageError: the run has no such topic, or pyarrow or pandas is missing.
            LogError: the topic cannot be decoded.
        """
        with needs("a frame", "notebook"):
            import pandas  # noqa: F401

            return topic(self, name).to_pandas()

    def plot(self) -> Any:
        """A figure of matplotlib, see :func:`draw`.

        Raises:
            UsageError: matplotlib is missing.
            LogError: the run has no control cycles.
        """
        figure, axes = for_notebook(5, (8.0, 9.5), sharex=True)
        draw(self, axes)
        return figure


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
        parameters: true parameters by name; the others are nominal.
        seed: of the sensors' noise.
        policy: ONNX file (default: the shipped actor).
        quick: the shipped actor for a short experiment, until all four parameters are known to about 1 %.
        bench: bench file (default: the shipped one).
        duration: of the experiment [s] (default: the policy's horizon).

    Returns:
        The run, opened; :attr:`~emb_bench.logs.log.RunLog.exit_reason` says how it ended.

    Raises:
        EmbError: an argument is wrong, the policy does not fit the bench, or the log cannot be written.
    """
    from emb_runtime.cli.experiment import experiment
    from emb_runtime.cli.options import parser, prepare
    from emb_runtime.cli.session import Console

    options = {"plant": plant, "seed": seed, **(parameters or {})}
    iface = "sim:" + ",".join(f"{name}={value}" for name, value in options.items())
    arguments = ["--iface", iface, "--log", str(log)]
    for option, value in (("--policy", policy), ("--bench", bench), ("--duration", duration)):
        if value is not None:
            arguments += [option, str(value)]
    if quick:
        arguments.append("--quick")
    plan = prepare(parser().parse_args(arguments))
    experiment(plan, Path(log), Console())
    return open_run(log)


def open_run(log: str | Path) -> Run:
    """Open a log.

    Raises:
        UsageError: the file cannot be read.
        LogError: it is not a log, or too damaged.
    """
    opened = read_log(log)
    return Run(**{field.name: getattr(opened, field.name) for field in fields(RunLog)})


def topic(run: Source, name: str) -> Table:
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
    from emb_bench.export.export import arrow_batches

    schema, tables = arrow_batches(_opened(run), name)
    import pyarrow as pa

    parts = list(tables)
    return cast("Table", pa.concat_tables(parts) if parts else schema.empty_table())


def draw(run: Source, axes: Sequence[Axes]) -> None:
    """Draw a run on five axes of matplotlib: angle, velocity, currents, why currents were changed, states.

    Args:
        run: the run.
        axes: five, one above the other: ``plt.subplots(5, sharex=True)[1]``.

    Raises:
        UsageError: there are not five.
        LogError: the run has no control cycles.
    """
    from emb_bench.export.picture import draw_on

    draw_on(_opened(run), axes)


def export(
    run: Source,
    output: str | Path,
    *,
    topic: str | None = None,
    theta: str | Path | Mapping[str, float] | None = None,
) -> str:
    """A part of a run for another tool: a picture, one topic as a table with units, or the brake as a MuJoCo model.

    The frames on the bus go to BLF, ASC and others by can_logconvert RUN FILE.

    Args:
        run: MCAP file of emb-run.
        output: file to write: a picture (.png, .svg, .pdf), a table (.csv, .parquet) or a model (.xml) by its ending.
        topic: of a table (default: /cycle, the control cycles).
        theta: parameters of a model, as for fim (default: log, and nominal where it has no estimate).

    Returns:
        A description of what the file holds.

    Raises:
        UsageError: an argument is wrong, a library is missing, or the file cannot be written.
        LogError: the topic cannot be decoded, or the run has no control cycles.
    """
    from emb_bench.export.export import write

    return write(_opened(run), Path(output), topic, _text_of(theta))


def rerun(run: Source) -> Rerun:
    """Run the loop again from the log of a run, and compare what it decides.

    The control loop runs again with the policy, bench file and DBC of the log. Bus and clock give the frames and times
    that the log recorded. Each decision (policy, clip, shield, sent current, its reason), each estimate, each sent
    frame, each safety event and the outcome must be the same, numbers to the last bit. A cut log is compared up to its
    end. Rounding may differ with another ONNX Runtime, numpy, Python or processor. If a decision differs, the versions
    of the log are printed too.

    Args:
        run: MCAP file of emb-run.

    Returns:
        The differences, and how much was compared.

    Raises:
        UsageError: the run only listened.
        LogError: the log does not begin with its run, or carries no policy.
        PolicyError: the policy in the log is refused.
    """
    from emb_bench.rerun import rerun_as_recorded

    return rerun_as_recorded(_opened(run))


def info(run: Source) -> dict[str, Any]:
    """Summary of a run: end, counts, largest values, completeness.

    Args:
        run: MCAP file of emb-run.

    Raises:
        UsageError: the file cannot be read.
        LogError: it is not a log, or too damaged.
    """
    from emb_bench.logs.info import info_document

    return info_document(_opened(run))


def timing(runs: Source | Sequence[Source]) -> list[RunTiming]:
    """Timing of runs, judged by the budgets of their bench.

    How long each part of a control cycle took, by the time stamps in the log: sample to sample, sample to loop,
    decision, sending, sensor to command, and the time left before the answer would have been late. The times are
    compared with [budgets] of the bench file in the log. Simulated time is not judged.

    Args:
        runs: MCAP files of emb-run.

    Raises:
        UsageError: a file cannot be read.
        LogError: a log has no control cycles.
    """
    from emb_bench.report.runs import run_timing

    return [run_timing(_opened(run)) for run in _listed(runs)]


def fisher_information(
    run: Source,
    *,
    model: str | None = None,
    params: Names | None = None,
    nuisance: Names | None = None,
    prior: str | None = None,
    theta: str | Path | Mapping[str, float] | None = None,
    bench: str | Path | None = None,
    map: str | Path | None = None,  # noqa: A002  # as the option is called
) -> Evaluation:
    """Fisher information of a run: how precisely its parameters can be known at best.

    Intervals are the Cramer-Rao bound for sensors with noise and without systematic errors: no method can do better.
    emb-replay estimate also estimates the systematic errors of the bench file, so its repeatability is larger. -v adds
    the criteria over time, and the information as the thesis weights it.

    Args:
        run: MCAP file of emb-run; with a map, a recording of others.
        model: plant of the bench to evaluate with (default: the one that was simulated; exact where the log does not
            say).
        params: parameters to evaluate; all others are taken as known (default: the four of the brake).
        nuisance: unknowns besides (default: none).
        prior: name of ranges in the bench file in which the parameters are known to lie (default: none).
        theta: where to evaluate: 'log' for the running estimate in the log, 'nominal', 'true' of a
            simulated brake, 'name=value,...', or the JSON of an estimate or report (default: log, and
            nominal where it has no estimate).
        bench: bench file (default: the one in the log).
        map: map file of a recording of others: which column of it is what, and what is known of the machine.

    Returns:
        The evaluation: ``fisher("physical")`` and ``fisher("weighted")``, the fit of the model, and warnings.

    Raises:
        UsageError: a name is unknown, or the run only listened.
        LogError: the log says too little.
    """
    from emb_bench.experiment.from_log import read_experiment
    from emb_bench.experiment.theta import read_theta
    from emb_bench.information.evaluation import Question, bench_for, default_model, evaluate

    Question(*_unknowns(params, nuisance, None))  # a wrong name needs no log to be refused
    log = _driven(run, map)
    its = bench_for(log, bench)
    question = Question(*_unknowns(params, nuisance, its), None if prior is None else its.range_set(prior))
    plant = its.model(model or default_model(log)[0])
    name, brake, errors = read_theta(_text_of(theta), log, its)
    return evaluate(log, read_experiment(log, its), its, [plant], question, name, brake, errors)[0]


def estimate(
    runs: Source | Sequence[Source],
    *,
    params: Names | None = None,
    nuisance: Names | None = None,
    method: Literal["oem", "pem", "rls", "windows"] | None = None,
    model: str | None = None,
    systematic: Literal["bench", "none"] = "bench",
    prior: str | None = None,
    known: Names | None = None,
    window: float = 0.0,
    starts: int = STARTS,
    seed: int = 0,
    profile: bool = False,
    last: str | Path | None = None,
    bench: str | Path | None = None,
    map: str | Path | None = None,  # noqa: A002  # as the option is called
) -> Study:
    """Parameters of a brake from its runs, with total and repeatability, and whether the model explains them.

    The verdict on the model comes first, then each parameter, the largest part of its uncertainty, and the next step.
    Of several logs, each is also predicted from the others.

    Args:
        runs: MCAP files of emb-run, of one brake, which are taken together; with a map, recordings of others.
        params: parameters to estimate (default: the four of the brake; what the map of a recording guesses).
        nuisance: further unknowns to estimate (default: none, or what the map of a recording says).
        method: see above (default: oem; windows for a recording).
        model: plant of the bench to estimate with, or 'all': each is fitted, and the best is used (default: the one
            that was simulated; exact where a log does not say).
        systematic: 'bench' also estimates sensor offsets, gain and delay, with priors from [systematic] of the bench
            file; 'none' assumes ideal sensors (default: bench).
        prior: name of ranges in the bench file in which the parameters are known to lie (default: none).
        known: parameters that were measured otherwise, such as k_m=0.0217±0.1%; J is then estimated (default: none, or
            k_m where [systematic] of the bench file says how well it is known).
        window: length of the windows [s], with method windows (default: what the map says, or 0.5).
        starts: local searches (default: 8).
        seed: seed of the starts of these searches (default: 0).
        profile: likelihood profiles of all parameters (default: of those that are identified badly).
        last: JSON of an earlier estimate or report, to say what has changed since.
        bench: bench file (default: the one in the first log).
        map: map file of recordings of others: which column of them is what, and what is known of the machine.

    Returns:
        The study; ``study.estimate.theta`` has the values, ``study.conclusions`` what is known of each parameter.

    Raises:
        UsageError: an argument is wrong, the runs do not go together, or scipy and numba are missing.
        LogError: a log says too little.
    """
    given = locals()
    options_of, before = _study_options(given), _last(last)
    from emb_bench.analysis.study import make_study

    logs = [_driven(run, map) for run in _listed(runs)]
    if not logs:
        raise UsageError("expected at least one run")
    its = logs[0].bench if bench is None else load_bench(bench, analysis=True)
    say_if_compiling()
    _say(f"estimates from {', '.join(log.path.name for log in logs)}")
    return make_study(its, logs, options_of(its), last=before)


def report(
    runs: Source | Sequence[Source],
    output: str | Path,
    *,
    acceptance: str | Path | None = None,
    junit: str | Path | None = None,
    **options: Any,
) -> Content:
    """One page about runs of one brake, to hand over, and a JSON file beside it.

    The verdict comes first, then the evidence. The page is one file for screen and paper. A log that cannot be used is
    named and left out. A run without an experiment is reported without an estimate.

    Args:
        runs: MCAP files of emb-run, of one brake; with a map, recordings of others. What cannot be used is named on
            the page and left out.
        output: page to write, .html or .htm.
        acceptance: TOML file with an [acceptance] table: tolerances, drift, budgets; each is passed, failed, or not
            decided.
        junit: XML file to write with the results of the acceptance criteria as test cases.
        options: of :func:`estimate`; ``profile`` is on.

    Returns:
        What the page shows: the runs, the study, the acceptance.

    Raises:
        UsageError: an argument is wrong, the runs do not go together, a file cannot be written, or scipy, numba or
            matplotlib is missing.
        LogError: not one log can be used.
    """
    page = Path(output)
    beside = page.parent / f"{page.stem}.json"
    bound = inspect.signature(estimate).bind(runs, **options | {"profile": True})
    bound.apply_defaults()
    given = bound.arguments
    files = [*_listed(runs), given["last"], given["map"], acceptance]
    for path in (entry.path if isinstance(entry, RunLog) else Path(entry) for entry in files if entry):
        if path.resolve() in (page.resolve(), beside.resolve()):
            raise UsageError(f"--output {page}: would write over {path}, which is read: choose another name")
    require_place("--output", page, PAGES)
    require_place("--junit", None if junit is None else Path(junit), (".xml",))
    if junit is not None and acceptance is None:
        raise UsageError("--junit: expected it with --acceptance")
    options_of = _study_options(given)
    with needs("a report", "bench"):
        import matplotlib  # noqa: F401
    from emb_bench.report import acceptance as test
    from emb_bench.report.content import gather
    from emb_bench.report.page import document, report_page

    before = _last(given["last"])
    criteria = None if acceptance is None else test.read_criteria(Path(acceptance))
    say_if_compiling()
    with replacing(page) as new_page, replacing(beside) as new_numbers:
        logs, left_out = _usable(_listed(runs), given["map"])
        _say(f"estimates from {', '.join(log.path.name for log in logs)}, and writes {page.name}")
        own = next((log for log in logs if "bench.toml" in log.attachments), logs[-1])
        its = own.bench if given["bench"] is None else load_bench(given["bench"], analysis=True)
        made_by = f"emb-excite {metadata.version('emb-excite')}"
        content = gather(its, logs, left_out, options_of(its), made_by, last=before, criteria=criteria)
        new_numbers.write_text(as_json(document(content)) + "\n", encoding="utf-8")
        new_page.write_text(report_page(content), encoding="utf-8")
        if junit is not None and content.acceptance is not None:
            with replacing(Path(junit)) as new_cases:
                new_cases.write_text(test.junit(content.acceptance), encoding="utf-8")
    return content


def campaign(
    paths: str | Path | Sequence[str | Path],
    output: str | Path,
    *,
    method: Literal["none", "oem", "pem", "rls", "windows"] = "oem",
    model: str | None = None,
    params: Names | None = None,
    nuisance: Names | None = None,
    prior: str | None = None,
    starts: int = STARTS,
    seed: int = 0,
    bench: str | Path | None = None,
    jobs: int | None = None,
    time_limit: float = 600.0,
    ray: str | None = None,
) -> Campaign:
    """Many logs in parallel: one row each in a Parquet or CSV file, and what they say together.

    A row has the identity of the run, its Fisher information at the bench's nominal brake, and an estimate of the
    parameters. A log that cannot be evaluated becomes a row with the reason. The rows do not depend on the number of
    processes or machines. On a Ray cluster all machines need emb-excite and the logs at the same paths.

    Args:
        paths: logs, or folders to search for *.mcap.
        output: file to write, Parquet or CSV by its ending.
        method: see above, or 'none' for information alone (default: oem).
        model: plant to estimate with (default: the one that was simulated; exact where a log does not say).
        params: parameters to estimate (default: the four of the brake).
        nuisance: further unknowns to estimate (default: none).
        prior: name of ranges in the bench file in which the parameters are known to lie (default: none).
        starts: local searches (default: 8).
        seed: seed of the starts of these searches (default: 0).
        bench: bench file (default: the one in each log).
        jobs: logs at a time (default: one for each processor).
        time_limit: longest time for one log [s]; one that takes longer has failed (default: 600).
        ray: address of a Ray cluster, or 'local' for a Ray of this machine (default: processes of this machine).

    Returns:
        The summary; the rows are in the file.

    Raises:
        UsageError: an argument is wrong, there is no log, a library is missing, or a file cannot be written.
    """
    from emb_bench.batch.campaign import run_campaign
    from emb_bench.batch.row import Options
    from emb_bench.estimate.records import EstimationProblem
    from emb_bench.information.evaluation import Question

    _check({"--starts": (starts, 1), "--seed": (seed, 0), "--jobs": (1 if jobs is None else jobs, 1)})
    if not 1e-3 <= time_limit <= 1e6:
        raise UsageError(f"--time-limit: expected 0.001 to 1e6 s, got {time_limit:g}")
    names = _unknowns(params, nuisance, None)
    if method != "none":
        EstimationProblem(*names)
    Question(*names)
    its = None if bench is None else load_bench(bench, analysis=True)
    if its is not None:
        its.plant(model or DEFAULT_PLANT)
        Question(*names, None if prior is None else its.range_set(prior))
    options = Options(method, *names, model, prior, None if its is None else its.text, starts, seed)
    places = [Path(path) for path in ([paths] if isinstance(paths, str | Path) else paths)]
    return run_campaign(places, Path(output), options, jobs=jobs, time_limit=time_limit, ray=ray)


def design(
    *,
    criterion: Literal["D", "A", "E"] = "D",
    params: Names = PARAMETER_NAMES,
    theta: str | Path | Mapping[str, float] | None = None,
    model: str = DEFAULT_PLANT,
    kind: Literal["physical", "weighted"] = "physical",
    return_home: bool = True,
    starts: int = COARSE_SEARCHES,
    seed: int = 0,
    bench: str | Path | None = None,
    told: Callable[[str], object] | None = None,
) -> Report:
    """The current sequence with most information about parameters that are known, under the limits of the bench.

    Args:
        criterion: what is optimised (default: D).
        params: unknown parameters (default: the four of the brake).
        theta: the brake's parameters, as name=value,...; the others are nominal.
        model: plant of the bench (default: exact).
        kind: which Fisher information (default: physical).
        return_home: the brake returns home at the end; without, it may end anywhere within the limits.
        starts: coarse searches (default: 18).
        seed: seed of the random starts (default: 0).
        bench: bench file (default: the shipped one).
        told: called after each step of the search with what was done (default: a bar on a terminal).

    Returns:
        The report; ``report.found.best.currents`` are the currents [A], one per sample period.

    Raises:
        UsageError: an argument is wrong, no design was found, or scipy and numba are missing.
    """
    from emb_bench.design.problem import make_problem
    from emb_bench.information.criteria import Criterion
    from emb_bench.sim.simulated_brake import parse_assignments, true_parameters

    _check({"--starts": (starts, 1), "--seed": (seed, 0)})
    its, names = load_bench(bench), _names(params)
    goal = Criterion(criterion)
    given = parse_assignments(_text_of(theta).replace("nominal", ""), "--theta: ")
    brake = true_parameters(its, given, option="--theta: ")
    problem = make_problem(its, goal, names, model=model, kind=kind, brake=brake, returns=return_home)
    with needs("a design", "bench"):
        from emb_bench.design.report import make_report
        from emb_bench.design.search import steps_of
    say_if_compiling()
    with progress("design", steps_of(starts)) as advance:
        return make_report(its, problem, goal, kind, starts=starts, seed=seed, told=told or advance)


def _say(text: str) -> None:
    """Tell who waits at a terminal what takes the time."""
    if sys.stderr is not None and sys.stderr.isatty():
        mention(f"{text} ...")


def _opened(run: Source, map_path: str | Path | None = None) -> RunLog:
    """The log of a run; with a map, a recording of others."""
    if isinstance(run, RunLog):
        return run
    if map_path is None:
        from emb_bench.recordings.map_file import KINDS

        if Path(run).suffix.lower() in KINDS:
            raise UsageError(f"{run}: a recording of others needs its map file: --map FILE")
        return read_log(run)
    from emb_bench.recordings.recording import open_recording

    return open_recording(Path(run), Path(map_path))


def _driven(run: Source, map_path: str | Path | None) -> RunLog:
    log = _opened(run, map_path)
    require_driven(log)
    return log


def _listed(runs: Source | Sequence[Source]) -> list[Source]:
    """The runs one by one; UsageError if one comes twice, under whatever name."""
    found = [runs] if isinstance(runs, RunLog | str | Path) else list(runs)
    real = [os.path.realpath(run.path if isinstance(run, RunLog) else run) for run in found]
    if twice := [run for n, run in enumerate(found) if real[n] in real[:n]]:
        raise UsageError(f"{getattr(twice[0], 'path', twice[0])} comes twice: expected each run once")
    return found


def _names(names: Names) -> tuple[str, ...]:
    """Names, or a text with commas between them."""
    listed = names.split(",") if isinstance(names, str) else names
    return tuple(name for entry in listed if (name := entry.strip()))


def _unknowns(
    params: Names | None, nuisance: Names | None, bench: Bench | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Parameters and nuisances; those that are not given are the machine's of the bench, if it has one."""
    machine = None if bench is None else bench.machine
    default = (PARAMETER_NAMES, ()) if machine is None else (machine.unknown, machine.nuisances)
    return default[0] if params is None else _names(params), default[1] if nuisance is None else _names(nuisance)


def _text_of(theta: str | Path | Mapping[str, float] | None) -> str:
    """Parameters as the option ``--theta`` has them."""
    if isinstance(theta, Mapping):
        return ",".join(f"{name}={value!r}" for name, value in theta.items()) or "nominal"
    return "" if theta is None else str(theta)


def _check(options: Mapping[str, tuple[int, int]]) -> None:
    """Check numbers against the least that each may be.

    Raises:
        UsageError: one is smaller.
    """
    for option, (value, least) in options.items():
        if value < least:
            raise UsageError(f"{option}: expected a number from {least}, got {value}")


def _study_options(given: Mapping[str, Any]) -> Callable[[Bench], StudyOptions]:
    """Options of a study, but for what the bench says; wrong ones are refused before any log is read.

    Raises:
        UsageError: an option is wrong, or scipy and numba are missing.
    """
    _check({f"--{name}": (given[name], least) for name, least in (("starts", 1), ("seed", 0))})
    if not (given["window"] == 0.0 or 1e-3 <= given["window"] <= 3600.0):
        raise UsageError(f"--window: expected a time from 0.001 to 3600 s, got {given['window']:g}")
    from emb_bench.estimate.records import EstimationProblem, freed

    unknowns, known = (given["params"], given["nuisance"]), _known(given["known"])
    EstimationProblem(*_unknowns(*unknowns, None), window=given["window"])
    with needs("an estimate", "bench"):
        import numba  # noqa: F401

        from emb_bench.analysis.study import StudyOptions

    def of(bench: Bench) -> StudyOptions:
        prior = None if given["prior"] is None else bench.range_set(given["prior"])
        method = given["method"] or ("oem" if bench.machine is None else "windows")
        if given["window"] and method != "windows":
            raise UsageError(f"--window: the method {method} has no windows; leave it out, or add --method windows")
        asked = EstimationProblem(*_unknowns(*unknowns, bench), prior, known=known, window=given["window"])
        if unasked := [name for name in known if name not in asked.names]:
            raise UsageError(f"--known {', '.join(unasked)}: expected one of {', '.join(asked.names)}")
        return StudyOptions(
            freed(asked, bench),
            method,
            given["model"],
            given["starts"],
            given["seed"],
            given["profile"],
            given["systematic"] == "bench",
        )

    return of


NUMBER = r"(?:[0-9]+[.]?[0-9]*|[.][0-9]+)(?:[eE][-+]?[0-9]+)?"  # Without a sign


def _known(given: Names | None) -> dict[str, tuple[float, float]]:
    """Value and standard deviation of each known parameter, SI units, as ``--known`` has them."""
    found = {}
    for text in () if given is None else _names(given):
        parts = re.fullmatch(rf"(\w+)=({NUMBER})(?:±|\+-)({NUMBER})(%?)", text)
        value, half = (float(parts[2]), float(parts[3])) if parts else (0.0, 0.0)
        if parts is None or not (0.0 < value < math.inf and 0.0 < half < math.inf):
            raise UsageError(
                f"--known: expected a parameter with half of its 95 % interval, as k_m=0.0217±0.1%, got '{text}'"
            )
        found[parts[1]] = value, half * (0.01 * value if parts[4] else 1.0) / NORMAL_95
    return found


def _last(path: str | Path | None) -> Earlier | None:
    """An earlier estimate."""
    if path is None:
        return None
    from emb_bench.analysis.drift import read_last

    return read_last(Path(path))


def _usable(runs: Sequence[Source], map_path: str | Path | None) -> tuple[list[RunLog], list[tuple[Path, str]]]:
    """The logs that can be read, and why the others cannot.

    Raises:
        UsageError: a file is not there or not readable.
        LogError: there is one path, and it is not a log; or none is.
    """
    logs, left_out = [], []
    for run in runs:
        try:
            logs.append(_opened(run, map_path))
        except LogError as err:
            if len(runs) == 1:
                raise
            path = run.path if isinstance(run, RunLog) else Path(run)
            left_out.append((path, str(err).removeprefix(f"{path}: ")))
    if not logs:
        raise LogError("not one of these logs can be used: " + "; ".join(f"{path}: {why}" for path, why in left_out))
    return logs, left_out
