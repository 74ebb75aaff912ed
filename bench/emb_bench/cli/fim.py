"""``emb-replay fim``: the information of a recorded experiment about the brake's parameters."""

from __future__ import annotations

import argparse

from emb_bench import api
from emb_bench.cli.options import add, add_output_options, answer, given, summary
from emb_bench.report.fim import document, models_text, text
from emb_runtime.config.plants import EVERY
from emb_runtime.errors import EXIT_DONE

HELP = summary(api.fisher_information)
DESCRIPTION = f"""\
{HELP}. Intervals are half of the 95 % interval by sensor
noise alone (the Cramer-Rao bound): no method can do better from this record. With -v
the criteria over time, and the information as the thesis weights it.
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    add(p, api.fisher_information)
    add_output_options(p)


def run(args: argparse.Namespace) -> int:
    """Evaluate a log; gives the exit code.

    Raises:
        UsageError: a wrong argument, an unreadable file, or one of a run that only listened.
        LogError: the log is none, or too damaged.
    """
    options = given(args, api.fisher_information)
    if options.get("model") == EVERY:
        del options["model"]
        every = api.compare_models(**options)
        answer(args, lambda: {"models": [document(e) for e in every]}, lambda _: models_text(every))
    else:
        found = api.fisher_information(**options)
        answer(args, lambda: document(found), lambda verbose: text(found, verbose=verbose))
    return EXIT_DONE
