"""``emb-replay``: evaluation of logs. The options of a command are the record that the function behind it takes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Collection, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from emb_bench import api
from emb_bench.api.arguments import opened
from emb_bench.brake.parameters import PARAMETERS
from emb_bench.cli.live import LiveOptions, live
from emb_bench.cli.options import add, add_output_options, description, given, print_answer, summary
from emb_bench.options import Options
from emb_bench.output import reported_if_interrupted
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
    from emb_bench.analysis.study import Result, Study
    from emb_bench.information.evaluation import Evaluation

METHODS = """\

methods:
  oem      output error: simulated angle and velocity nearest to the measured ones
  pem      prediction error: a Kalman filter, for brakes with disturbances
  rls      recursive least squares: simple and biased, as a baseline
  windows  output error over windows, for machines without a spring
"""
UNKNOWNS = METHODS + "\nThe names of unknowns are in the help of emb-replay estimate.\n"


# ---- the functions of the commands, from arguments to exit code ----


def _fim(args: argparse.Namespace) -> int:
    from emb_bench.report.fim import fim_document, fim_text

    found = cast("Evaluation", api.fisher_information(args.run, given(args, api.FimOptions)))  # of one log
    print_answer(args, lambda: fim_document(found), lambda verbose: fim_text(found, verbose=verbose))
    return EXIT_DONE


def _estimate(args: argparse.Namespace) -> int:
    study = api.estimate(args.runs, given(args, api.EstimateOptions))
    from emb_bench.report.estimate import study_document, study_text

    print_answer(args, lambda: study_document(study), lambda verbose: study_text(study, verbose=verbose))
    return _exit_code(study, strict=args.strict)


def _exit_code(study: Study, accepted: Result | None = None, *, strict: bool) -> int:
    """Exit code of a verdict. Without ``--strict`` only a recording's misfit is one, whose faults a map may hold."""
    from emb_bench.analysis.study import Code, verdict

    if not strict:
        estimates = [one.joint for one in study.side_by_side or [study] if one.joint is not None]
        misfits = [e for e in estimates if e.bench.machine is not None and not e.validation.fits]
        return EXIT_CHECK_FAILED if misfits else EXIT_DONE
    fits = EXIT_OUTSIDE if study.outside else EXIT_DONE
    codes = {Code.FITS: fits, Code.ACCEPTED: EXIT_DONE, Code.UNDECIDED: EXIT_CANNOT_TELL}
    return codes.get(verdict(study, accepted).code, EXIT_CHECK_FAILED)


def _report(args: argparse.Namespace) -> int:
    made = api.report(args.runs, args.output, given(args, api.ReportOptions))
    from emb_bench.report.sentences import outside

    for run in made.study.reported:
        if run.log.missing:
            show(f"WARNING: {run.name}: {run.log.missing}")
    for name, line in outside(made.study, made.bench):
        show(f"{name}: {line}")
    show(f"{args.output} and {args.output.with_suffix('.json').name}: {made.sentence}")
    for line in made.without_part:
        complain("emb-replay", LogError(line))
    if made.without_part:
        return EXIT_CHECK_FAILED
    accepted = None if made.acceptance is None else made.acceptance.result
    return _exit_code(made.study, accepted, strict=args.strict)


def _export(args: argparse.Namespace) -> int:
    options = given(args, api.ExportOptions)
    log = opened(args.run, options.map)
    holds = api.export(log, args.output, options)
    warning = f"WARNING: {log.missing}\n" if log.missing else ""
    document = {"log": str(args.run), "file": str(args.output), "holds": holds, "missing": log.missing}
    print_answer(args, lambda: document, lambda _: f"{warning}{args.output}: {holds}")
    return EXIT_DONE


def _campaign(args: argparse.Namespace) -> int:
    found = api.campaign(args.paths, args.output, given(args, api.CampaignOptions))
    from emb_bench.batch.summary import campaign_document, campaign_text

    print_answer(args, lambda: campaign_document(found), lambda verbose: campaign_text(found, verbose=verbose))
    if not found.evaluated:
        return EXIT_LOG
    return EXIT_CHECK_FAILED if found.failed else EXIT_DONE


def _rerun(args: argparse.Namespace) -> int:
    from emb_bench.report import runs

    again = api.rerun(args.run)
    print_answer(args, lambda: runs.rerun_document(again), lambda verbose: runs.rerun_text(again, verbose=verbose))
    return EXIT_DONE if again.reproduced else EXIT_CHECK_FAILED


def _info(args: argparse.Namespace) -> int:
    from emb_bench.report import runs

    document = api.info(args.run)
    print_answer(args, lambda: document, lambda verbose: runs.info(document, verbose=verbose))
    return EXIT_DONE


def _timing(args: argparse.Namespace) -> int:
    from emb_bench.report import runs

    found = api.timing(args.runs)
    print_answer(
        args,
        lambda: {"logs": [runs.timing_document(entry) for entry in found]},
        lambda verbose: "\n\n".join(runs.timing_text(entry, verbose=verbose) for entry in found),
    )
    codes = {entry.exit_code for entry in found}
    return next(code for code in (EXIT_CHECK_FAILED, EXIT_USAGE, EXIT_DONE) if code in codes)


def _live(args: argparse.Namespace) -> int:
    live(getattr(args, "place", Path("runs")), given(args, LiveOptions))
    return EXIT_DONE


# ---- the commands ----


ARGUMENTS = {"run": ("RUN", None), "runs": ("RUN", "+"), "paths": ("PATH", "+"), "place": ("DIR|LOG", "?")}
"""Arguments behind the name of a command: how each is shown, and how many there may be."""


class Command(NamedTuple):
    """One command."""

    function: Callable[..., Any]  # Its docstring is the command's description
    run: Callable[[argparse.Namespace], int]  # Gives the exit code
    codes: Collection[int]
    example: str  # Arguments to begin with
    argument: str = "run"
    argument_help: str = "MCAP file of emb-run"
    options: type[Options] = Options
    output: str = ""  # Help of ``--output``, if the command has it
    more: str = ""  # Help below the docstring
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
RUNS = "MCAP files of emb-run, of one brake; with a map, recordings of others"
COMMANDS: Mapping[str, Command] = {
    "info": Command(api.info, _info, OF_A_LOG, "run.mcap"),
    "estimate": Command(
        api.estimate,
        _estimate,
        (*CHECKED, EXIT_OUTSIDE),
        "run.mcap --json > estimate.json",
        "runs",
        "MCAP files of emb-run, of one brake, which are taken together; with a map, recordings of others",
        api.EstimateOptions,
        more=f"{METHODS}\nunknowns for --nuisance, besides the parameters:\n"
        + "".join(f"  {name:17}  {row.about}\n" for name, row in PARAMETERS.items() if row.about),
        strict=f"exit with 1 if {MISFIT}; else with {EXIT_OUTSIDE} if the brake is outside the shield's ranges",
    ),
    "report": Command(
        api.report,
        _report,
        (*CHECKED, EXIT_CANNOT_TELL, EXIT_OUTSIDE),
        "run.mcap -o report.html --acceptance acceptance.toml --strict",
        "runs",
        f"{RUNS}. What cannot be used is named on the page and left out",
        api.ReportOptions,
        "page to write, .html or .htm",
        UNKNOWNS,
        strict=f"exit with {EXIT_CHECK_FAILED} if a criterion failed, else {EXIT_CANNOT_TELL} if one is not "
        f"decided; without --acceptance as emb-replay estimate does",
    ),
    "fim": Command(
        api.fisher_information,
        _fim,
        OF_A_LOG,
        "run.mcap --theta nominal --params k_m,f_v",
        argument_help="MCAP file of emb-run; with a map, a recording of others",
        options=api.FimOptions,
    ),
    "timing": Command(
        api.timing,
        _timing,
        CHECKED,
        "runs/*.mcap",
        "runs",
        "MCAP files of emb-run",
        more="\nExit code 2 also if a bench file has no [budgets].\n",
    ),
    "rerun": Command(api.rerun, _rerun, (*CHECKED, EXIT_POLICY_REFUSED), "run.mcap"),
    "export": Command(
        api.export,
        _export,
        CHECKED,
        "run.mcap -o brake.fmu",
        argument_help="MCAP file of emb-run; for a model with a map, a recording of others",
        options=api.ExportOptions,
        output="file to write: a picture (.png, .svg, .pdf), a table (.csv, .parquet) or a model (.fmu, .c, .dcm, "
        ".xml) by its ending",
        more="\nThe options behind --draw are those of the estimate of a model: see the help of emb-replay estimate.\n",
    ),
    "campaign": Command(
        api.campaign,
        _campaign,
        CHECKED,
        "runs -o campaign.parquet --jobs 4",
        "paths",
        "logs, or folders to search for *.mcap",
        api.CampaignOptions,
        "file to write, Parquet or CSV by its ending",
        UNKNOWNS,
    ),
    "live": Command(
        live,
        _live,
        (EXIT_DONE, EXIT_USAGE, EXIT_LOG),
        "runs",
        "place",
        "folder whose logs are shown, or one log; its parent folder must exist (default: runs/)",
        LiveOptions,
    ),
}
"""Commands in the order of ``--help``, which is that of their use."""
EXAMPLES = """\
examples:
  emb-replay info run.mcap
  emb-replay estimate run.mcap
  emb-replay report run.mcap -o report.html
"""
CUT = "\nA cut log (kill -9, full disk) is read as far as it goes, and the missing part is named.\n"


def epilog(codes: Collection[int]) -> str:
    """The end of a ``--help``."""
    lines = [f"  {code:<4} {MEANINGS[code]}\n" for code in sorted(codes)]
    return f"exit codes:\n{''.join(lines)}{CUT if EXIT_LOG in codes else ''}"


def parser(only: str | None = None) -> argparse.ArgumentParser:
    """The command line of all commands, or of ``only`` one."""
    p = Parser(
        prog="emb-replay",
        description="Evaluate logs of emb-run.",
        epilog=f"{EXAMPLES}\n{epilog([*MEANINGS])}",
    )
    commands = p.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS if only is None else (only,):
        one = COMMANDS[name]
        command = commands.add_parser(
            name,
            help=summary(one.function.__doc__),
            description=f"{description(one.function.__doc__)}\n{one.more}",
            epilog=f"example:\n  emb-replay {name} {one.example}\n\n{epilog(one.codes)}",
        )
        metavar, nargs = ARGUMENTS[one.argument]
        form: dict[str, Any] = {"metavar": metavar, "nargs": nargs, "help": one.argument_help}
        command.add_argument(one.argument, type=Path, default=argparse.SUPPRESS, **form)
        if one.output:
            command.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help=one.output)
        add(command, one.options)
        if name not in ("report", "live"):
            add_output_options(command)
        if one.strict:
            command.add_argument("--strict", action="store_true", help=one.strict)
        command.set_defaults(start=one.run)
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
