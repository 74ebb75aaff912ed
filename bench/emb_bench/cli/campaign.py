"""``emb-replay campaign``: many logs, one row each."""

from __future__ import annotations

import argparse

from emb_bench import api
from emb_bench.cli.estimate import METHODS
from emb_bench.cli.options import add, add_output_options, answer, given, summary
from emb_bench.output import reported_if_interrupted
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE, EXIT_LOG

HELP = summary(api.campaign)
DESCRIPTION = f"""\
{HELP}.
A row says what the run was, its Fisher information at the bench's nominal brake, and
an estimate of the parameters. A log that cannot be evaluated becomes a row with the
reason. The rows are the same however many processes or machines made them; on a Ray
cluster all machines need emb-excite and the logs at the same paths.

{METHODS}
The names of unknowns are in the help of emb-replay estimate.
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    add(p, api.campaign)
    add_output_options(p)


def run(args: argparse.Namespace) -> int:
    """Evaluate a campaign; gives the exit code.

    Raises:
        UsageError: a wrong argument, no log, a missing library, or a result that cannot be written.
    """
    with reported_if_interrupted("emb-replay campaign"):
        found = api.campaign(**given(args, api.campaign))
    from emb_bench.batch.summary import document, text

    answer(args, lambda: document(found), lambda verbose: text(found, verbose=verbose))
    if not found.evaluated:
        return EXIT_LOG
    return EXIT_CHECK_FAILED if found.failed else EXIT_DONE
