"""Fisher information."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from emb_bench.api.arguments import Names, Source, driven, text_of, unknowns

if TYPE_CHECKING:
    from emb_bench.information.evaluation import Evaluation


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

    Question(*unknowns(params, nuisance, None))  # a wrong name needs no log to be refused
    log = driven(run, map)
    its = bench_for(log, bench)
    question = Question(*unknowns(params, nuisance, its), None if prior is None else its.range_set(prior))
    plant = its.model(model or default_model(log)[0])
    name, brake, errors = read_theta(text_of(theta), log, its)
    return evaluate(log, read_experiment(log, its), its, [plant], question, name, brake, errors)[0]
