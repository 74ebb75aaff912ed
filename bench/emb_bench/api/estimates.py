"""Parameters of a brake from its runs, and the report on them."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from emb_bench.api.arguments import (
    Names,
    Source,
    check,
    driven,
    is_table,
    listed,
    names_of,
    opened,
    refuses,
    require_options,
    say,
    unknowns,
)  # fmt: skip
from emb_bench.config.bench import Bench, load_bench
from emb_bench.estimate.records import STARTS, EstimationProblem, freed
from emb_bench.logs.log import RunLog
from emb_bench.output import replacing, require_place, say_if_compiling
from emb_runtime.errors import LogError, UsageError, needs
from emb_runtime.estimator.estimate import NORMAL_95
from emb_runtime.system.terminal import as_json

if TYPE_CHECKING:  # scipy, numba and matplotlib come with the extra [bench]
    from emb_bench.analysis.drift import Earlier
    from emb_bench.analysis.study import Study, StudyOptions
    from emb_bench.report.content import Content

PAGES = (".html", ".htm")  # Endings of a report's page


@refuses
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
    asked = _Asked(params, nuisance, method, model, systematic, prior, known, window, starts, seed, profile)
    before = _earlier(last)
    from emb_bench.analysis.study import make_study

    logs = [driven(run, map) for run in listed(runs)]
    if not logs:
        raise UsageError("expected at least one run")
    its = logs[0].bench if bench is None else load_bench(bench, analysis=True)
    say_if_compiling()
    say(f"estimates from {', '.join(log.path.name for log in logs)}")
    return make_study(its, logs, asked.on(its), last=before)


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
    own_options = inspect.signature(estimate)
    require_options("report", options, [*own_options.parameters])
    bound = own_options.bind(runs, **options | {"profile": True})
    bound.apply_defaults()
    given = bound.arguments
    files = [*(run for run in listed(runs) if not is_table(run)), given["last"], given["map"], acceptance]
    for path in (Path(getattr(entry, "path", entry)) for entry in files if entry is not None):
        if path.resolve() in (page.resolve(), beside.resolve()):
            raise UsageError(f"--output {page}: would write over {path}, which is read: choose another name")
    require_place("--output", page, PAGES)
    require_place("--junit", None if junit is None else Path(junit), (".xml",))
    if junit is not None and acceptance is None:
        raise UsageError("--junit: expected it with --acceptance")
    asked = _Asked(**{field.name: given[field.name] for field in fields(_Asked)})
    with needs("a report", "bench"):
        import matplotlib  # noqa: F401
    from emb_bench.report import acceptance as test
    from emb_bench.report.content import gather
    from emb_bench.report.page import document, report_page

    before = _earlier(given["last"])
    criteria = None if acceptance is None else test.read_criteria(Path(acceptance))
    say_if_compiling()
    with replacing(page) as new_page, replacing(beside) as new_numbers:
        logs, left_out = _usable(listed(runs), given["map"])
        say(f"estimates from {', '.join(log.path.name for log in logs)}, and writes {page.name}")
        own = next((log for log in logs if "bench.toml" in log.attachments), logs[-1])
        its = own.bench if given["bench"] is None else load_bench(given["bench"], analysis=True)
        made_by = f"emb-excite {metadata.version('emb-excite')}"
        content = gather(its, logs, left_out, asked.on(its), made_by, last=before, criteria=criteria)
        new_numbers.write_text(as_json(document(content)) + "\n", encoding="utf-8")
        new_page.write_text(report_page(content), encoding="utf-8")
        if junit is not None and content.acceptance is not None:
            with replacing(Path(junit)) as new_cases:
                new_cases.write_text(test.junit(content.acceptance), encoding="utf-8")
    return content


@dataclass(frozen=True)
class _Asked:
    """Options of an estimate before its bench is known; wrong ones are refused before any log is read."""

    params: Names | None
    nuisance: Names | None
    method: str | None
    model: str | None
    systematic: str
    prior: str | None
    known: Names | None
    window: float
    starts: int
    seed: int
    profile: bool

    def __post_init__(self) -> None:
        """Check what can be checked without a bench, and that scipy and numba are there."""
        check({"--starts": (self.starts, 1), "--seed": (self.seed, 0)})
        if not (self.window == 0.0 or 1e-3 <= self.window <= 3600.0):
            raise UsageError(f"--window: expected a time from 0.001 to 3600 s, got {self.window:g}")
        _known(self.known)
        EstimationProblem(*unknowns(self.params, self.nuisance, None), window=self.window)
        with needs("an estimate", "bench"):
            import numba  # noqa: F401

            import emb_bench.analysis.study  # noqa: F401

    def on(self, bench: Bench) -> StudyOptions:
        """The options of a study; those that are not given are the machine's of the bench, if it has one."""
        from emb_bench.analysis.study import StudyOptions

        prior = None if self.prior is None else bench.range_set(self.prior)
        method = self.method or ("oem" if bench.machine is None else "windows")
        if self.window and method != "windows":
            raise UsageError(f"--window: the method {method} has no windows; leave it out, or add --method windows")
        names, known = unknowns(self.params, self.nuisance, bench), _known(self.known)
        asked = EstimationProblem(*names, prior, known=known, window=self.window)
        if unasked := [name for name in known if name not in asked.names]:
            raise UsageError(f"--known {', '.join(unasked)}: expected one of {', '.join(asked.names)}")
        return StudyOptions(
            freed(asked, bench),
            method,
            self.model,
            self.starts,
            self.seed,
            self.profile,
            self.systematic == "bench",
        )


NUMBER = r"(?:[0-9]+[.]?[0-9]*|[.][0-9]+)(?:[eE][-+]?[0-9]+)?"  # Without a sign


def _known(given: Names | None) -> dict[str, tuple[float, float]]:
    """Value and standard deviation of each known parameter, SI units, as ``--known`` has them."""
    found = {}
    for text in () if given is None else names_of(given):
        parts = re.fullmatch(rf"(\w+)=({NUMBER})(?:±|\+-)({NUMBER})(%?)", text)
        value, half = (float(parts[2]), float(parts[3])) if parts else (0.0, 0.0)
        if parts is None or not (0.0 < value < math.inf and 0.0 < half < math.inf):
            raise UsageError(
                f"--known: expected a parameter with half of its 95 % interval, as k_m=0.0217±0.1%, got '{text}'"
            )
        found[parts[1]] = value, half * (0.01 * value if parts[4] else 1.0) / NORMAL_95
    return found


def _earlier(path: str | Path | None) -> Earlier | None:
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
            logs.append(opened(run, map_path))
        except LogError as err:
            if len(runs) == 1:
                raise
            path = Path(str(getattr(run, "path", run)))
            left_out.append((path, str(err).removeprefix(f"{path}: ")))
    if not logs:
        raise LogError("not one of these logs can be used: " + "; ".join(f"{path}: {why}" for path, why in left_out))
    return logs, left_out
