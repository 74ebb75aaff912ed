"""``emb-replay``: evaluation of logs. The options of a command are the arguments of a function."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from emb_bench import api
from emb_bench.brake.parameters import PARAMETERS
from emb_bench.cli import live
from emb_bench.cli.options import add, add_output_options, answer, given, summary
from emb_bench.logs.info import info_document
from emb_bench.logs.log import read_log
from emb_bench.output import reported_if_interrupted
from emb_bench.report import fim, runs
from emb_bench.report.runs import RunTiming, run_timing
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
    found = api.fisher_information(**given(args, api.fisher_information))
    answer(args, lambda: fim.document(found), lambda verbose: fim.text(found, verbose=verbose))
    return EXIT_DONE


def _estimate(args: argparse.Namespace) -> int:
    study = api.estimate(**given(args, api.estimate))
    from emb_bench.report.estimate import document, text

    answer(args, lambda: document(study), lambda verbose: text(study, verbose=verbose))
    return _strict(study) if args.strict else EXIT_DONE


def _strict(study: Study | None) -> int:
    if study is None or study.stopped or not (study.holds and study.identified):
        return EXIT_CHECK_FAILED
    return EXIT_OUTSIDE if study.outside else EXIT_DONE


def _report(args: argparse.Namespace) -> int:
    content = api.report(**given(args, api.report), **given(args, api.estimate, leave_out=("runs",)))
    from emb_bench.report.sentences import outside, verdict

    for name, study in content.outside:
        show("\n".join(f"{name}: {line}" for line in outside(study)))
    show(f"{args.output} and {args.output.with_suffix('.json').name}: {verdict(content)}")
    for line in content.without_part:
        complain("emb-replay", LogError(line))
    return _accepted(content, strict=args.strict)


def _accepted(content: Content, *, strict: bool) -> int:
    if content.without_part:
        return EXIT_CHECK_FAILED
    if not strict:
        return EXIT_DONE
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
    from emb_bench.rerun import document, text

    answer(args, lambda: document(again), lambda verbose: text(again, verbose=verbose))
    return EXIT_DONE if again.reproduced else EXIT_CHECK_FAILED


def _repair(args: argparse.Namespace) -> int:
    found = api.repair(**given(args, api.repair))
    missing, kept = ((), None) if found is None else found
    written = None if found is None else str(args.output)
    document = {"log": str(args.run), "written": written, "missing": "; ".join(missing), "messages": kept}
    said = f"{args.run}: the log is whole: nothing to repair, and nothing was written"
    if found is not None:
        said = "\n".join([f"{args.output}: {kept} messages saved", *(f"missing  {what}" for what in missing)])
    answer(args, lambda: document, lambda _: said)
    return EXIT_DONE


def info(run: Path) -> dict[str, Any]:
    """Summary of a run: end, counts, largest values, completeness.

    Args:
        run: MCAP file of emb-run.
    """
    return info_document(read_log(run))


def _info(args: argparse.Namespace) -> int:
    document = info(args.run)
    answer(args, lambda: document, lambda verbose: runs.info(document, verbose=verbose))
    return EXIT_DONE


def timing(runs: Sequence[Path]) -> list[RunTiming]:
    """Timing of runs, judged by the budgets of their bench.

    Args:
        runs: MCAP files of emb-run.
    """
    return [run_timing(read_log(path)) for path in runs]


def _timing(args: argparse.Namespace) -> int:
    found = timing(**given(args, timing))
    answer(
        args,
        lambda: {"logs": [runs.timing_document(entry) for entry in found]},
        lambda verbose: "\n\n".join(runs.timing_text(entry, verbose=verbose) for entry in found),
    )
    codes = {entry.exit_code for entry in found}
    return next(code for code in (EXIT_CHECK_FAILED, EXIT_USAGE, EXIT_DONE) if code in codes)


# ---- the commands ----


class Command(NamedTuple):
    """One command."""

    help: str
    description: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]  # Gives the exit code


def _command(
    function: Callable[..., Any], run: Callable[[argparse.Namespace], int], text: str = "", strict: str = ""
) -> Command:
    """A command whose options and help are a function's; ``strict`` is the help of ``--strict``, if it has that."""

    def add_arguments(p: argparse.ArgumentParser) -> None:
        add(p, function)
        if function is api.report:
            add(p, api.estimate, leave_out=("runs", "profile"))
        else:
            add_output_options(p)
        if strict:
            p.add_argument("--strict", action="store_true", help=strict)

    def reported(args: argparse.Namespace) -> int:
        with reported_if_interrupted(f"emb-replay {args.command}"):
            return run(args)

    return Command(summary(function), f"{summary(function)}.\n{text}", add_arguments, reported)


MEANINGS: Mapping[int, str] = {
    EXIT_DONE: "done",
    EXIT_CHECK_FAILED: "a check failed, or a log could not be used (it is named)",
    EXIT_USAGE: "usage: wrong argument, a file that cannot be read or written, a missing library, or no budgets",
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
COMMANDS: Mapping[str, tuple[Command, Collection[int]]] = {
    "fim": (
        _command(
            api.fisher_information,
            _fim,
            "Intervals are the Cramer-Rao bound for sensors with noise and without systematic errors: no\n"
            "method can do better. emb-replay estimate also estimates the systematic errors of the\n"
            "bench file, so its repeatability is larger. -v adds the criteria over time, and the\n"
            "information as the thesis weights it.\n",
        ),
        OF_A_LOG,
    ),
    "estimate": (
        _command(
            api.estimate,
            _estimate,
            "The verdict on the model comes first, then each parameter, the largest part of its\n"
            "uncertainty, and the next step. Of several logs, each is also predicted from the others.\n"
            f"{METHODS}\nunknowns for --nuisance, besides the parameters:\n"
            + "".join(f"  {name:17} {row.about}\n" for name, row in PARAMETERS.items() if row.about),
            strict=f"exit with 1 if {MISFIT}; else with {EXIT_OUTSIDE} if the brake is outside the shield's ranges",
        ),
        (*CHECKED, EXIT_OUTSIDE),
    ),
    "report": (
        _command(
            api.report,
            _report,
            "The verdict comes first, then the evidence. The page is one file for screen and paper. A\n"
            "log that cannot be used is named and left out. A run without an experiment is reported\n"
            f"without an estimate.\n{UNKNOWNS}",
            strict=f"exit with {EXIT_CHECK_FAILED} if a criterion failed, else {EXIT_CANNOT_TELL} if one is not "
            f"decided; without --acceptance as emb-replay estimate does",
        ),
        (*CHECKED, EXIT_CANNOT_TELL, EXIT_OUTSIDE),
    ),
    "campaign": (
        _command(
            api.campaign,
            _campaign,
            "A row has the identity of the run, its Fisher information at the bench's nominal brake,\n"
            "and an estimate of the parameters. A log that cannot be evaluated becomes a row with the\n"
            "reason. The rows do not depend on the number of processes or machines. On a Ray cluster\n"
            f"all machines need emb-excite and the logs at the same paths.\n{UNKNOWNS}",
        ),
        CHECKED,
    ),
    "info": (_command(info, _info), OF_A_LOG),
    "timing": (
        _command(
            timing,
            _timing,
            "How long each part of a control cycle took, by the time stamps in the log: sample to\n"
            "sample, sample to loop, decision, sending, sensor to command, and the time left before\n"
            "the answer would have been late. The times are compared with [budgets] of the bench file\n"
            "in the log. Simulated time is not judged.\n",
        ),
        CHECKED,
    ),
    "rerun": (
        _command(
            api.rerun,
            _rerun,
            "The control loop runs again with the policy, bench file and DBC of the log. Bus and clock\n"
            "give the frames and times that the log recorded. Each decision (policy, clip, shield, sent\n"
            "current, its reason), each estimate and each safety event up to the stop must be the same,\n"
            "numbers to the last bit. A cut log is compared up to its end. Rounding may differ with\n"
            "another ONNX Runtime, numpy, Python or processor. If a decision differs, the versions of\n"
            "the log are printed too.\n",
        ),
        (*CHECKED, EXIT_POLICY_REFUSED),
    ),
    "repair": (
        _command(
            api.repair,
            _repair,
            "The new file has a summary, indexes and checksums. Topics, schemas, times, sequence\n"
            "numbers, attachments and metadata stay as they were. The file says in itself what is\n"
            "missing, so that nothing takes it for a complete log. Of a whole log nothing is written.\n",
        ),
        OF_A_LOG,
    ),
    "export": (
        _command(api.export, _export, "The frames on the bus go to BLF, ASC and others by can_logconvert RUN FILE.\n"),
        OF_A_LOG,
    ),
    "live": (Command(live.HELP, live.DESCRIPTION, live.add_arguments, live.run), (EXIT_DONE, EXIT_USAGE, EXIT_LOG)),
}
"""Commands and their exit codes, in the order of ``--help``."""


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
    p.add_argument("--version", action="version", version=f"emb-replay {metadata.version('emb-excite')}")
    commands = p.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS if only is None else (only,):
        found, codes = COMMANDS[name]
        command = commands.add_parser(
            name,
            help=found.help,
            description=found.description,
            epilog=epilog(codes),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        found.add_arguments(command)
        command.set_defaults(start=found.run)
    return p


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``emb-replay``."""
    argv = sys.argv[1:] if argv is None else argv
    try:
        args = parser(argv[0] if argv and argv[0] in COMMANDS else None).parse_args(argv)
        return int(args.start(args))
    except EmbError as err:
        return complain("emb-replay", err)


if __name__ == "__main__":
    sys.exit(main())
