"""``emb-replay report``: one page about one or several runs."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from emb_bench.cli.estimate import GLOSSARY, METHODS_EXPLAINED, NUISANCES_EXPLAINED, add_options, asked_of, options_of
from emb_bench.logs.log import RunLog, read_log
from emb_bench.output import replacing, reported_if_interrupted, say_if_compiling
from emb_bench.report.text import show
from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.errors import EXIT_CANNOT_TELL, EXIT_CHECK_FAILED, EXIT_DONE, LogError, UsageError
from emb_runtime.system.terminal import as_json, complain

if TYPE_CHECKING:
    from emb_bench.report.content import Content

HELP = "one page to hand over: verdict, parameters, what they stand on, safety, identity"
DESCRIPTION = f"""\
Write one page about one or several runs of one brake: first whether the numbers can be believed and what they say, then
what they stand on. The page needs nothing but itself, on the screen and on paper. The same content as numbers goes into
a JSON file beside it. A log that cannot be used is named on the page and left out; a run without an experiment is
reported without an estimate. Pages and JSON files of that name are replaced.

{METHODS_EXPLAINED}{NUISANCES_EXPLAINED}"""
ENDINGS = (".html", ".htm")  # Of the page


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    p.add_argument(
        "-o", "--output", required=True, type=Path, metavar="FILE", help=f"page to write, {' or '.join(ENDINGS)}"
    )
    p.add_argument(
        "--acceptance",
        type=Path,
        metavar="FILE",
        help="TOML file with an [acceptance] table: tolerances, drift, budgets; each is passed, failed, or not decided",
    )
    p.add_argument(
        "--strict",
        action="store_true",
        help=f"exit with {EXIT_CHECK_FAILED} if a criterion failed, else {EXIT_CANNOT_TELL} if one is not decided; "
        f"without --acceptance with {EXIT_CHECK_FAILED} if a run was stopped, the model does not fit or predict, or a "
        "parameter is not identified",
    )
    add_options(p)
    p.epilog = f"{GLOSSARY}{p.epilog}"
    p.set_defaults(profile=True)


def run(args: argparse.Namespace) -> int:
    """Write the page and the JSON beside it; gives the exit code.

    Raises:
        UsageError: a wrong argument, logs that do not go together, a file that cannot be written, or scipy, numba or
            matplotlib is missing.
        LogError: not one log can be used, or one that is held out cannot.
    """
    page: Path = args.output
    beside = page.with_suffix(".json")
    read = [path for path in (args.last, args.acceptance) if path is not None]
    _check_output(page, beside, [*args.logs, *args.hold_out, *read])
    asked = asked_of(args)
    try:
        import matplotlib  # noqa: F401
        import numba  # noqa: F401

        from emb_bench.analysis.acceptance import read_criteria
        from emb_bench.analysis.drift import read_last
        from emb_bench.report.content import document, gather
        from emb_bench.report.page import report_page
        from emb_bench.report.render import phrase
    except ImportError as err:
        raise UsageError(
            "emb-replay report needs scipy, numba and matplotlib: pip install 'emb-excite[bench]'"
        ) from err
    last = None if args.last is None else read_last(args.last)
    criteria = None if args.acceptance is None else read_criteria(args.acceptance)
    made_by = f"emb-excite {metadata.version('emb-excite')}"
    say_if_compiling()
    with reported_if_interrupted("emb-replay report"), replacing(page) as new_page, replacing(beside) as new_numbers:
        logs, left_out = _read(args.logs)
        held_out = [read_log(path) for path in args.hold_out]
        bench = _bench(logs) if args.bench is None else load_bench(args.bench, analysis=True)
        options = options_of(args, asked, bench)
        content = gather(bench, logs, left_out, options, made_by, held_out=held_out, last=last, criteria=criteria)
        new_numbers.write_text(as_json(document(content)) + "\n", encoding="utf-8")
        new_page.write_text(report_page(content), encoding="utf-8")
    show(f"{page} and {beside.name}: {phrase('verdict', content)}")
    for line in content.without_part:
        complain("emb-replay", LogError(line))
    return _exit_code(content, strict=args.strict)


def _exit_code(content: Content, *, strict: bool) -> int:
    if content.without_part:
        return EXIT_CHECK_FAILED
    if not strict:
        return EXIT_DONE
    if content.acceptance is not None:
        codes = {"pass": EXIT_DONE, "fail": EXIT_CHECK_FAILED, "cannot tell": EXIT_CANNOT_TELL}
        return codes[content.acceptance.result.value]
    study = content.study
    good = study is not None and study.holds and study.identified and not content.stopped
    return EXIT_DONE if good else EXIT_CHECK_FAILED


def _check_output(page: Path, beside: Path, inputs: Sequence[Path]) -> None:
    """Refuse what would write over a log or over the last campaign's numbers.

    Raises:
        UsageError: it would, or there is no such folder.
    """
    if page.suffix.lower() not in ENDINGS:
        raise UsageError(f"--output {page}: expected a name that ends in {' or '.join(ENDINGS)}")
    if not page.parent.is_dir():
        raise UsageError(f"--output {page}: there is no folder {page.parent}")
    for path in inputs:
        for made in (page, beside):
            if path.resolve() == made.resolve():
                raise UsageError(f"--output {page}: would write over {path}, which is read: choose another name")


def _read(paths: Sequence[Path]) -> tuple[list[RunLog], list[tuple[Path, str]]]:
    """The logs that can be read, and why the others cannot.

    Raises:
        UsageError: a file is not there or not readable.
        LogError: there is one path, and it is not a log; or none is.
    """
    logs, left_out = [], []
    for path in paths:
        try:
            logs.append(read_log(path))
        except LogError as err:
            if len(paths) == 1:
                raise
            left_out.append((path, str(err).removeprefix(f"{path}: ")))
    if not logs:
        raise LogError("not one of these logs can be used: " + "; ".join(f"{path}: {why}" for path, why in left_out))
    return logs, left_out


def _bench(logs: Sequence[RunLog]) -> Bench:
    """The bench inside the first log that has one.

    Raises:
        LogError: none has.
    """
    for log in logs[:-1]:
        if "bench.toml" in log.attachments:
            return log.bench
    return logs[-1].bench
