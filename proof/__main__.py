"""``python -m proof``: check the shield's argument for a bench, and print what came of each lemma."""

from __future__ import annotations

import argparse
import sys

from emb_runtime.config.bench import load_bench
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE, EXIT_INTERRUPTED, EmbError
from emb_runtime.system.terminal import as_json, complain, mention, show
from proof.cases import case_of
from proof.lemmas import BOXES, SOLVER, Verdict, judge, lemmas

COMMAND = "proof"
LOOKED = {SOLVER: "paths", BOXES: "boxes"}
HEAD = "| lemma | statement | by | looked at | result | least slack | s |\n|---|---|---|---|---|---|---|"


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {COMMAND}",
        description="Check the argument that the envelope shield keeps the limits, for every brake of a bench's set.",
        epilog="exit codes: 0 every lemma is proved; 1 one is not; 2 wrong usage, bench, or no solver; 130 interrupted",
    )
    parser.add_argument("--bench", metavar="FILE", help="bench file; the shipped one without it")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    args = parser.parse_args(argv)
    try:
        case = case_of(load_bench(args.bench))
        verdicts = []
        if not args.json:
            show(HEAD)
        for lemma in lemmas(case):
            verdicts.append(judge(lemma, case))
            if not args.json:
                show(row(verdicts[-1]))
        proved = sum(v.proved for v in verdicts)
        if args.json:
            show(as_json({"bench": case.bench.name, "lemmas": [v._asdict() for v in verdicts]}))
        else:
            show(f"\n{proved} of {len(verdicts)} lemmas are proved for '{case.bench.name}'")
    except EmbError as err:
        return complain(COMMAND, err)
    except KeyboardInterrupt:
        mention(f"{COMMAND}: interrupted")
        return EXIT_INTERRUPTED
    return EXIT_DONE if proved == len(verdicts) else EXIT_CHECK_FAILED


def row(v: Verdict) -> str:
    """One line of the table."""
    looked = f"{v.looked} {LOOKED[v.method]}"
    slack = "exact" if v.slack is None else f"{v.slack:.2g}"
    result = "proved" if v.proved else f"NOT PROVED: {v.reason}"
    return f"| {v.key} | {v.statement} | {v.method} | {looked} | {result} | {slack} | {v.seconds:.1f} |"


if __name__ == "__main__":
    sys.exit(main())
