"""``emb-replay estimate``: parameters from logs."""

from __future__ import annotations

import argparse

from emb_bench import api
from emb_bench.brake.parameters import PARAMETERS
from emb_bench.cli.options import add, add_output_options, answer, given, summary
from emb_bench.output import reported_if_interrupted
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE

METHODS = """\
methods:
  oem      output error: simulated angle and velocity nearest to the measured ones
  pem      prediction error: a Kalman filter, for brakes that are disturbed
  rls      recursive least squares: simple and biased, as a baseline
  windows  output error over windows, for machines without a spring
"""
NUISANCES = "\nunknowns for --nuisance, besides the parameters:\n" + "".join(
    f"  {name:17} {row.about}\n" for name, row in PARAMETERS.items() if row.about
)
HELP = summary(api.estimate)
DESCRIPTION = f"""\
{HELP}.
The verdict on the model comes first; then each parameter, what limits its interval,
and the next step. Of several logs, each is also predicted from the others.

{METHODS}{NUISANCES}"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    add(p, api.estimate)
    add_output_options(p)
    p.add_argument(
        "--strict",
        action="store_true",
        help="exit with 1 if the model does not fit, does not predict a log, or a parameter is not identified",
    )


def run(args: argparse.Namespace) -> int:
    """Estimate; gives the exit code.

    Raises:
        UsageError: a wrong argument, logs that do not go together, or scipy or numba is missing.
        LogError: a log cannot be read.
    """
    with reported_if_interrupted("emb-replay estimate"):
        study = api.estimate(**given(args, api.estimate))
    from emb_bench.report.estimate import document, text

    answer(args, lambda: document(study), lambda verbose: text(study, verbose=verbose))
    return EXIT_CHECK_FAILED if args.strict and not (study.holds and study.identified) else EXIT_DONE
