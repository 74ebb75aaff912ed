"""Parameters of a brake from its runs, and the report on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emb_bench.analysis.options import EstimateOptions, ReportOptions
from emb_bench.api.arguments import AnyRun, driven, is_table, listed, opened, options_of, say
from emb_bench.config.bench import load_bench
from emb_bench.logs.log import RunLog
from emb_bench.output import replacing, require_place, say_if_compiling
from emb_runtime.errors import LogError, UsageError, needs
from emb_runtime.system.terminal import json_document

if TYPE_CHECKING:  # scipy, numba and matplotlib come with the extra [bench]
    from emb_bench.analysis.drift import Earlier
    from emb_bench.analysis.study import Study
    from emb_bench.report.report import Report

PAGES = (".html", ".htm")  # Endings of a report's page


def estimate(runs: AnyRun | Sequence[AnyRun] = (), options: EstimateOptions | None = None, **more: Any) -> Study:
    """Parameters of a brake from its runs, with total and repeatability, and whether the model explains them.

    The verdict on the model comes first, then each parameter, the largest part of its uncertainty, and the next step.
    Of several logs, each is also predicted from the others.

    Args:
        runs: MCAP files of emb-run, of one brake, which are taken together; with a map, recordings of others.
        options: a record of options.
        more: its fields as keywords: ``estimate(run, params="f_v")``.

    Returns:
        The study; ``study.estimate.theta`` has the values, ``study.conclusions`` the conclusion on each parameter.

    Raises:
        UsageError: an argument is wrong, the runs do not go together, or scipy and numba are missing.
        LogError: a log has too little data.
    """
    settings = options_of("estimate", EstimateOptions, options, more)
    _require_estimates()
    before = _earlier(settings)
    from emb_bench.analysis.stages import make_study

    logs = [driven(run, settings.map) for run in listed(runs)]
    if not logs:
        raise UsageError("expected at least one run")
    its = logs[0].bench if settings.bench is None else load_bench(settings.bench, analysis=True)
    say_if_compiling()
    say(f"estimates from {', '.join(log.path.name for log in logs)}")
    return make_study(its, logs, settings, last=before)


def report(
    runs: AnyRun | Sequence[AnyRun], output: str | Path, options: ReportOptions | None = None, **more: Any
) -> Report:
    """Report page on runs of one brake, and a JSON file beside it.

    The verdict comes first, then the evidence. The page is one file for screen and paper. An unusable log is named and
    skipped. A run without an experiment is reported without an estimate. With ``compare`` two runs stand side by side,
    each estimated alone, with the differences of their parameters; the worse verdict counts.

    Args:
        runs: MCAP files of emb-run, of one brake; with a map, recordings of others. Unusable ones are named
            on the page and skipped.
        output: page to write, .html or .htm.
        options: a record of options.
        more: its fields as keywords, those of :func:`estimate` among them.

    Returns:
        What the page is about: the study with its runs, the acceptance.

    Raises:
        UsageError: an argument is wrong, the runs do not go together, a file cannot be written, or scipy, numba or
            matplotlib is missing.
        LogError: not one log can be used.
    """
    page = Path(output)
    beside = page.parent / f"{page.stem}.json"
    settings = options_of("report", ReportOptions, options, more)
    files = [*(run for run in listed(runs) if not is_table(run)), settings.last, settings.map, settings.acceptance]
    for path in (Path(getattr(entry, "path", entry)) for entry in files if entry is not None):
        if path.resolve() in (page.resolve(), beside.resolve()):
            raise UsageError(f"--output {page}: would write over {path}, which is read: choose another name")
    require_place("--output", page, PAGES)
    require_place("--junit", None if settings.junit is None else Path(settings.junit), (".xml",))
    if settings.junit is not None and settings.acceptance is None:
        raise UsageError("--junit: expected it with --acceptance")
    if settings.compare and len(listed(runs)) != 2:
        raise UsageError(f"--compare: expected two runs, got {len(listed(runs))}")
    _require_estimates()
    with needs("a report", "bench"):
        import matplotlib  # noqa: F401
    from emb_bench.analysis.stages import make_study, side_by_side
    from emb_bench.report import acceptance as test
    from emb_bench.report.page import html
    from emb_bench.report.report import Report, page_of, report_document

    before = _earlier(settings)
    criteria = None if settings.acceptance is None else test.read_criteria(Path(settings.acceptance))
    say_if_compiling()
    with replacing(page) as new_page, replacing(beside) as new_numbers:
        logs, left_out = _usable(listed(runs), settings)
        say(f"estimates from {', '.join(log.path.name for log in logs)}, and writes {page.name}")
        with_bench = next((log for log in logs if "bench.toml" in log.attachments), logs[-1])
        its = with_bench.bench if settings.bench is None else load_bench(settings.bench, analysis=True)
        made_by = f"emb-excite {metadata.version('emb-excite')}"
        if settings.compare and left_out:
            raise LogError("--compare: " + "; ".join(f"{path}: {why}" for path, why in left_out))
        if settings.compare:
            study = side_by_side(its, logs, settings)
        else:
            study = make_study(its, logs, settings, last=before, for_report=True)
        made = Report(study, its, left_out, made_by)
        if criteria is not None and settings.acceptance is not None:
            accepted = test.accept(criteria, Path(settings.acceptance).name, study, made.without_part)
            made = replace(made, acceptance=accepted)
        new_numbers.write_text(json_document(report_document(made)) + "\n", encoding="utf-8")
        new_page.write_text(html(page_of(made)), encoding="utf-8")
        if settings.junit is not None and made.acceptance is not None:
            with replacing(Path(settings.junit)) as new_cases:
                new_cases.write_text(test.junit(made.acceptance), encoding="utf-8")
    return made


def _require_estimates() -> None:
    """Refuse where the libraries of an estimate are missing, before any log is read."""
    with needs("an estimate", "bench"):
        import numba  # noqa: F401

        import emb_bench.analysis.stages  # noqa: F401


def _earlier(options: EstimateOptions) -> Earlier | None:
    """The earlier estimate that this one is compared with."""
    if options.last is None:
        return None
    from emb_bench.analysis.drift import read_last

    return read_last(Path(options.last))


def _usable(runs: Sequence[AnyRun], options: ReportOptions) -> tuple[list[RunLog], list[tuple[Path, str]]]:
    """The logs that can be read, and why the others cannot.

    Raises:
        UsageError: a file is not there or not readable.
        LogError: there is one path, and it is not a log; or none is.
    """
    logs, left_out = [], []
    for run in runs:
        try:
            logs.append(opened(run, options.map))
        except LogError as err:
            if len(runs) == 1:
                raise
            path = Path(str(getattr(run, "path", run)))
            left_out.append((path, str(err).removeprefix(f"{path}: ")))
    if not logs:
        raise LogError("not one of these logs can be used: " + "; ".join(f"{path}: {why}" for path, why in left_out))
    return logs, left_out
