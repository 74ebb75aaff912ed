"""``emb-replay report``: one page about one or several runs."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from emb_bench import api
from emb_bench.cli.estimate import METHODS
from emb_bench.cli.options import add, given, summary
from emb_bench.output import reported_if_interrupted
from emb_bench.report.text import show
from emb_runtime.errors import EXIT_CANNOT_TELL, EXIT_CHECK_FAILED, EXIT_DONE, LogError
from emb_runtime.system.terminal import complain

if TYPE_CHECKING:
    from emb_bench.report.content import Content

HELP = summary(api.report)
DESCRIPTION = f"""\
{HELP}.
The verdict comes first, then what it rests on. The page needs nothing but itself, on
the screen and on paper. A log that cannot be used is named and left out; a run without
an experiment is reported without an estimate.

{METHODS}
The names of unknowns are in the help of emb-replay estimate.
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    add(p, api.report)
    add(p, api.estimate, leave_out=("runs", "profile"))
    p.add_argument(
        "--strict",
        action="store_true",
        help=f"exit with {EXIT_CHECK_FAILED} if a criterion failed, else {EXIT_CANNOT_TELL} if one is not decided; "
        f"without --acceptance with {EXIT_CHECK_FAILED} if a run was stopped, the model does not fit or predict, or a "
        "parameter is not identified",
    )


def run(args: argparse.Namespace) -> int:
    """Write the page and the JSON beside it; gives the exit code.

    Raises:
        UsageError: see :func:`emb_bench.api.report`.
        LogError: not one log can be used, or one that is held out cannot.
    """
    with reported_if_interrupted("emb-replay report"):
        content = api.report(**given(args, api.report), **given(args, api.estimate, leave_out=("runs",)))
    from emb_bench.report.sentences import verdict

    show(f"{args.output} and {args.output.with_suffix('.json').name}: {verdict(content)}")
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
