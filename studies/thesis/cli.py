"""``python -m studies.thesis``: what the thesis prints about its figures and tables, computed anew, with a verdict."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from emb_bench.config.bench import Bench, load_bench
from emb_runtime.config.bench import Sensors
from emb_runtime.errors import EXIT_DONE, EXIT_INTERRUPTED, EmbError, UsageError, needs
from emb_runtime.system.terminal import complain, mention, show
from studies.thesis.determinant_facts import protected_facts, unprotected_facts
from studies.thesis.facts import Fact, Statement, facts_text
from studies.thesis.oscillator import oscillator_facts
from studies.thesis.two_parameters import two_parameter_facts

PROGRAM = "python -m studies.thesis"
ANALYSIS: Mapping[str, Callable[[Bench], list[Statement]]] = {
    "fig-4.2": unprotected_facts,
    "fig-4.3": protected_facts,
    "fig-5.1": oscillator_facts,
    "sec-6.1": two_parameter_facts,
}
"""Statements about the thesis's equations, by figure or section; none needs a training."""
TRAININGS = (
    *("fig-5.2", "fig-5.3", "fig-5.4", "fig-5.5", "fig-5.6", "fig-5.7", "fig-5.8", "table-5.1", "fig-5.9"),
    *("fig-6.1", "fig-6.2", "fig-6.3", "table-6.2"),
)
"""Figures and tables of trained agents; here so that they are known without importing torch."""
SEEDS = 5  # Number of seeds of the thesis in Fig. 5.9
EPILOG = f"""\
analysis (seconds): {", ".join(ANALYSIS)}
trainings: {", ".join(TRAININGS)}

Each statement of the thesis gets a verdict: 'agrees' or 'does not follow' (from its own equations, or in trainings made
again), or 'only suggested' where the thesis says no more than that it is possible. docs/studies/ explains what does not
follow. Trainings are kept in DIR: one that is there is not repeated. Table 5.1, Fig. 5.9 and Table 6.2 take all seeds,
the others the first: 70 million environment steps, with --seeds 1 18 million. With --steps no verdict counts.

exit codes: 0 done, whatever the verdicts are; 1 a training diverged; 2 usage; 130 interrupted
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Check what is printed in Guo (TU Darmstadt, 2024).",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("figure", nargs="*", help="some of those below, 'analysis' (the default) or 'trainings'")
    p.add_argument("--json", action="store_true", help="print JSON")
    p.add_argument(
        "-o", "--output", type=Path, metavar="DIR", default=Path("trainings"), help="trainings (default: %(default)s)"
    )
    p.add_argument("--steps", type=int, metavar="N", help="most steps of a training (default: as its preset has)")
    p.add_argument("--seeds", type=int, metavar="N", default=SEEDS, help="trainings of one kind (default: %(default)s)")
    p.add_argument("--seed", type=int, metavar="S", default=0, help="the first seed (default: %(default)s)")
    return p


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``python -m studies.thesis``."""
    args = parser().parse_args(argv)
    try:
        with needs("the thesis's analysis", "train"):
            show(_run(args))
    except EmbError as err:
        return complain(PROGRAM, err)
    except KeyboardInterrupt:
        mention(f"{PROGRAM}: interrupted; remove the training that it was making")
        return EXIT_INTERRUPTED
    return EXIT_DONE


def _run(args: argparse.Namespace) -> str:
    groups = {"analysis": list(ANALYSIS), "trainings": list(TRAININGS)}
    names = [name for asked in args.figure or ["analysis"] for name in groups.get(asked, [asked])]
    for name in names:
        if name not in ANALYSIS and name not in TRAININGS:
            raise UsageError(f"no figure or table is called '{name}'; there are: {', '.join([*ANALYSIS, *TRAININGS])}")
    if min(args.seeds, 1 if args.steps is None else args.steps) < 1 or args.seed < 0:
        raise UsageError("expected --seeds and --steps of at least 1, and a --seed of at least 0")
    bench = load_bench()
    measured = replace(bench, sensors=Sensors())  # with white noise, R = diag(1e-6, 1)
    facts = [Fact(name, *statement) for name in names if name in ANALYSIS for statement in ANALYSIS[name](measured)]
    if trained := [name for name in names if name in TRAININGS]:
        from studies.thesis.agents import agent_facts
        from studies.thesis.trainings import Trainings

        seeds = range(args.seed, args.seed + args.seeds)
        trainings = Trainings(args.output, bench, seeds, args.steps, lambda what: mention(f"{PROGRAM}: {what}"))
        facts += [fact for name in trained for fact in agent_facts(name, trainings)]
    if args.json:
        return json.dumps([fact.document() for fact in facts], indent=1, allow_nan=False)
    agreeing, differing = (sum(fact.agrees is said for fact in facts) for said in (True, False))
    count = (
        f"{agreeing} of {len(facts)} statements agree, {differing} do not follow, "
        f"{len(facts) - agreeing - differing} are only suggested"
    )
    return f"{facts_text(facts)}\n\n{count if args.steps is None else 'a rehearsal: no verdict of a training counts'}"


if __name__ == "__main__":
    sys.exit(main())
