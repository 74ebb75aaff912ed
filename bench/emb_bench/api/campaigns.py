"""Many logs, each evaluated on its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from emb_bench.api.arguments import Names, check, unknowns
from emb_bench.config.bench import load_bench
from emb_bench.config.plants import DEFAULT_PLANT
from emb_bench.estimate.records import STARTS
from emb_runtime.errors import UsageError

if TYPE_CHECKING:
    from emb_bench.batch.summary import Campaign


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

    check({"--starts": (starts, 1), "--seed": (seed, 0), "--jobs": (1 if jobs is None else jobs, 1)})
    if not 1e-3 <= time_limit <= 1e6:
        raise UsageError(f"--time-limit: expected 0.001 to 1e6 s, got {time_limit:g}")
    names = unknowns(params, nuisance, None)
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
