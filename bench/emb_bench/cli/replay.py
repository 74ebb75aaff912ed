"""``emb-replay``: evaluation of logs. The options of a command are the arguments of a function."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Collection, Mapping
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from emb_bench import api
from emb_bench.brake.parameters import PARAMETERS
from emb_bench.cli.live import live
from emb_bench.cli.options import add, add_output_options, answer, description, given, summary
from emb_bench.output import reported_if_interrupted
from emb_bench.report import fim, runs
from emb_bench.report.text import show
from emb_runtime.errors import (
    EXIT_CANNOT_TELL,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_LOG,
    EXIT_OUTSIDE,
    EXIT_POLICY_REFUSED,
    EXIT_USAGE,
    EmbError,
    LogError,
)
from emb_runtime.system.terminal import Parser, complain

if TYPE_CHECKING:
    from emb_bench.analysis.study import Study
    from emb_bench.information.evaluation import Evaluation
    from emb_bench.report.content import Content

METHODS = """\

methods:
  oem      output error: simulated angle and velocity nearest to the measured ones
  pem      prediction error: a Kalman filter, for brakes that are disturbed
  rls      recursive least squares: simple and biased, as a baseline
  windows  output error over windows, for machines without a spring
"""
UNKNOWNS = METHODS + "\nThe names of unknowns are in the help of emb-replay estimate.\n"


# ---- what each command does, from its arguments to its exit code ----


def _fim(args: argparse.Namespace) -> int:
    found = cast("Evaluation", api.fisher_information(**given(args, api.fisher_information)))  # of one log
    answer(args, lambda: fim.document(found), lambda verbose: fim.text(found, verbose=verbose))
    return EXIT_DONE


def _estimate(args: argparse.Namespace) -> int:
    study = api.estimate(**given(args, api.estimate))
    from emb_bench.report.estimate import document, text

    answer(args, lambda: document(study), lambda verbose: text(study, verbose=verbose))
    return _strict(study) if args.strict else _recorded(study)


def _recorded(study: Study | None) -> int:
    """Exit code without ``--strict``: only of a recording of others, whose faults a map may hold, is a misfit one."""
    recorded = study is not None and study.estimate.bench.machine is not None
    return EXIT_CHECK_FAILED if study is not None and recorded and not study.model_fits else EXIT_DONE


def _strict(study: Study | None) -> int:
    if study is None or study.stopped or not (study.holds and study.identified):
        return EXIT_CHECK_FAILED
    return EXIT_OUTSIDE if study.outside else EXIT_DONE


def _report(args: argparse.Namespace) -> int:
    content = api.report(**given(args, api.report), **given(args, api.estimate, leave_out=("runs",)))
    from emb_bench.report.sentences import outside

    for name, study in content.outside:
        show("\n".join(f"{name}: {line}" for line in outside(study)))
    show(f"{args.output} and {args.output.with_suffix('.json').name}: {content.verdict}")
    for line in content.without_part:
        complain("emb-replay", LogError(line))
    return _accepted(content, strict=args.strict)


def _accepted(content: Content, *, strict: bool) -> int:
    if content.without_part:
        return EXIT_CHECK_FAILED
    if not strict:
        return _recorded(content.study)
    if content.acceptance is not None:
        codes = {"pass": EXIT_DONE, "fail": EXIT_CHECK_FAILED, "cannot tell": EXIT_CANNOT_TELL}
        return codes[content.acceptance.result.value]
    return EXIT_CHECK_FAILED if content.stops else _strict(content.study)


def _export(args: argparse.Namespace) -> int:
    log = api.open_run(args.run)
    holds = api.export(**given(args, api.export) | {"run": log})
    warning = f"WARNING: {log.missing}\n" if log.missing else ""
    document = {"log": str(args.run), "file": str(args.output), "holds": holds, "missing": log.missing}
    answer(args, lambda: document, lambda _: f"{warning}{args.output}: {holds}")
    return EXIT_DONE


def _campaign(args: argparse.Namespace) -> int:
    found = api.campaign(**given(args, api.campaign))
    from emb_bench.batch.summary import document, text

    answer(args, lambda: document(found), lambda verbose: text(found, verbose=verbose))
    if not found.evaluated:
        return EXIT_LOG
    return EXIT_CHECK_FAILED if found.failed else EXIT_DONE


def _rerun(args: argparse.Namespace) -> int:
    again = api.rerun(args.run)
    answer(args, lambda: runs.rerun_document(again), lambda verbose: runs.rerun_text(again, verbose=verbose))
    return EXIT_DONE if again.reproduced else EXIT_CHECK_FAILED


def _info(args: argparse.Namespace) -> int:
    document = api.info(args.run)
    answer(args, lambda: document, lambda verbose: runs.info(document, verbose=verbose))
    return EXIT_DONE


def _timing(args: argparse.Namespace) -> int:
    found = api.timing(args.runs)
    answer(
        args,
        lambda: {"logs": [runs.timing_document(entry) for entry in found]},
        lambda verbose: "\n\n".join(runs.timing_text(entry, verbose=verbose) for entry in found),
    )
    codes = {entry.exit_code for entry in found}
    return next(code for code in (EXIT_CHECK_FAILED, EXIT_USAGE, EXIT_DONE) if code in codes)


def _live(args: argparse.Namespace) -> int:
    live(**given(args, live))
    return EXIT_DONE


# ---- the commands ----


class Command(NamedTuple):
    """One command."""

    function: Callable[..., Any]  # Its signature and docstring are the command's options and help
    run: Callable[[argparse.Namespace], int]  # Gives the exit code
    codes: Collection[int]
    more: str = ""  # Help below what the docstring says
    strict: str = ""  # Help of ``--strict``, if the command has it


MEANINGS: Mapping[int, str] = {
    EXIT_DONE: "done",
    EXIT_CHECK_FAILED: "a check failed, a log could not be used (it is named), or a recording with --map does not fit",
    EXIT_USAGE: "usage: wrong argument, a file that cannot be read or written, or a missing library",
    EXIT_POLICY_REFUSED: "the policy in the log is refused",
    EXIT_LOG: "not a log, or too damaged or too short for a result",
    EXIT_CANNOT_TELL: "--strict: not every acceptance criterion can be decided",
    EXIT_OUTSIDE: "--strict: the brake is outside the ranges for which the limits are guaranteed",
    EXIT_INTERRUPTED: "Ctrl-C: nothing is written",
}
"""Exit codes and their meanings."""
OF_A_LOG = (EXIT_DONE, EXIT_USAGE, EXIT_LOG, EXIT_INTERRUPTED)
CHECKED = (*OF_A_LOG, EXIT_CHECK_FAILED)

MISFIT = "a run was stopped, the model does not fit, does not predict a log, or a parameter is not identified"
COMMANDS: Mapping[str, Command] = {
    "info": Command(api.info, _info, OF_A_LOG),
    "estimate": Command(
        api.estimate,
        _estimate,
        (*CHECKED, EXIT_OUTSIDE),
        f"{METHODS}\nunknowns for --nuisance, besides the parameters:\n"
        + "".join(f"  {name:17} {row.about}\n" for name, row in PARAMETERS.items() if row.about),
        strict=f"exit with 1 if {MISFIT}; else with {EXIT_OUTSIDE} if the brake is outside the shield's ranges",
    ),
    "report": Command(
        api.report,
        _report,
        (*CHECKED, EXIT_CANNOT_TELL, EXIT_OUTSIDE),
        UNKNOWNS,
        strict=f"exit with {EXIT_CHECK_FAILED} if a criterion failed, else {EXIT_CANNOT_TELL} if one is not "
        f"decided; without --acceptance as emb-replay estimate does",
    ),
    "fim": Command(api.fisher_information, _fim, OF_A_LOG),
    "timing": Command(api.timing, _timing, CHECKED, "\nExit code 2 also if a bench file has no [budgets].\n"),
    "rerun": Command(api.rerun, _rerun, (*CHECKED, EXIT_POLICY_REFUSED)),
    "export": Command(api.export, _export, OF_A_LOG),
    "campaign": Command(api.campaign, _campaign, CHECKED, UNKNOWNS),
    "live": Command(live, _live, (EXIT_DONE, EXIT_USAGE, EXIT_LOG)),
}
"""Commands in the order of ``--help``, which is that of their use."""
EXAMPLES: Mapping[str, str] = {
    "info": "run.mcap",
    "estimate": "run.mcap --json > estimate.json",
    "report": "run.mcap -o report.html --acceptance acceptance.toml --strict",
    "fim": "run.mcap --theta nominal --params k_m,f_v",
    "timing": "runs/*.mcap",
    "rerun": "run.mcap",
    "export": "run.mcap -o cycles.parquet --topic /cycle",
    "campaign": "runs -o campaign.parquet --jobs 4",
    "live": "runs",
}
"""Arguments of each to begin with."""


CUT = "\nA cut log (kill -9, full disk) is read as far as it goes, and the missing part is named.\n"


def epilog(codes: Collection[int]) -> str:
    """The end of a ``--help``."""
    lines = [f"  {code:<4} {MEANINGS[code]}\n" for code in sorted(codes)]
    return f"exit codes:\n{''.join(lines)}{CUT if EXIT_LOG in codes else ''}"


def parser(only: str | None = None) -> argparse.ArgumentParser:
    """The command line, of one command where it is known."""
    p = Parser(
        prog="emb-replay",
        description="Evaluate logs of emb-run.",
        epilog=epilog([*MEANINGS]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = p.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS if only is None else (only,):
        _, _, codes, more, strict = found = COMMANDS[name]
        command = commands.add_parser(
            name,
            help=summary(found.function),
            description=f"{description(found.function)}\n{more}",
            epilog=f"example:\n  emb-replay {name} {EXAMPLES[name]}\n\n{epilog(codes)}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        add(command, found.function, leave_out=("plant", "parameters"))
        if name == "report":
            add(command, api.estimate, leave_out=("runs", "profile"))
        elif name != "live":
            add_output_options(command)
        if strict:
            command.add_argument("--strict", action="store_true", help=strict)
        command.set_defaults(start=found.run)
    return p


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``emb-replay``."""
    argv = sys.argv[1:] if argv is None else argv
    try:
        args = parser(argv[0] if argv and argv[0] in COMMANDS else None).parse_args(argv)
        with nullcontext() if args.command == "live" else reported_if_interrupted(f"emb-replay {args.command}"):
            return int(args.start(args))
    except EmbError as err:
        return complain("emb-replay", err)


if __name__ == "__main__":
    sys.exit(main())
