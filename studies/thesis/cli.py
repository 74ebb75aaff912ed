"""``python -m studies.thesis``: what the thesis prints about its figures and tables, computed anew, with a verdict."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from emb_bench.config.bench import Bench, load_bench
from emb_bench.output import replacing, require_place
from emb_runtime.config.bench import Sensors
from emb_runtime.errors import EXIT_DONE, EXIT_INTERRUPTED, EmbError, UsageError, needs
from emb_runtime.system.terminal import complain, mention, show
from studies.thesis import pictures
from studies.thesis.determinant_facts import protected_facts, unprotected_facts
from studies.thesis.facts import Fact, Statement, facts_text
from studies.thesis.oscillator import oscillator_facts
from studies.thesis.table_6_1 import bench_text
from studies.thesis.two_parameters import two_parameter_facts

if TYPE_CHECKING:  # torch takes its time
    from studies.thesis.trainings import Trainings

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
    *("sec-6.2.1", "fig-6.1", "fig-6.2", "fig-6.3", "table-6.2"),
)
"""Figures and tables of trained agents; here so that they are known without importing torch."""
SEEDS = 5  # Number of seeds of the thesis in Fig. 5.9
EPILOG = f"""\
analysis (seconds): {", ".join(ANALYSIS)}
trainings: {", ".join(TRAININGS)}

Each statement of the thesis gets a verdict: 'agrees' or 'does not follow' (from its own equations, or in trainings made
again), or 'only suggested' where the thesis says no more than that it is possible. docs/studies/ explains what does not
follow. Trainings are kept in DIR: one that is there is not repeated. Table 5.1, Fig. 5.9 and Table 6.2 take all seeds,
the others the first: 71 million environment steps, with --seeds 1 19 million. With --steps no verdict counts. The next
call makes interrupted trainings anew; those of several seeds are made side by side.

--set gives values that the thesis does not print, or prints in two ways: deviation=6 (first standard deviation [A]),
tracking=0.1 (factor of the weights of the deviation from the quintic), draws=normal, normalised_by=nominal (eq. 4.17).
--choices compares 1 and 6 A, weights x 1 and x 0.1, seed by seed, and stops after --minutes; the next call goes on.

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
    p.add_argument("--figures", type=Path, metavar="DIR", help="draw the figures there, as PNG, and print their files")
    p.add_argument("--write-bench", type=Path, metavar="FILE", help="write the bench file of Table 6.1, and do no more")
    p.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a choice, see below")
    p.add_argument("--choices", action="store_true", help="count the statements that agree by choice, see below")
    p.add_argument("--minutes", type=float, metavar="M", help="begin no training after so long (default: no end)")
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
        mention(f"{PROGRAM}: interrupted; the next call makes what was not finished anew")
        return EXIT_INTERRUPTED
    return EXIT_DONE


def _run(args: argparse.Namespace) -> str:
    if args.write_bench is not None:
        require_place("--write-bench", args.write_bench, (".toml",))
        with replacing(args.write_bench) as beside:
            beside.write_text(bench_text(), encoding="utf-8")
        return f"{args.write_bench}: the brakes of Table 6.1, their middle as nominal, and a shield that covers them"
    ours, trained = (pictures.ANALYSIS, pictures.TRAINED) if args.figures is not None else (ANALYSIS, TRAININGS)
    groups = {"analysis": list(ours), "trainings": list(trained)}
    names = [name for asked in args.figure or ["analysis"] for name in groups.get(asked, [asked])]
    for name in names:
        if name not in ours and name not in trained:
            raise UsageError(f"no figure or table is called '{name}'; there are: {', '.join([*ours, *trained])}")
    if min(args.seeds, 1 if args.steps is None else args.steps) < 1 or args.seed < 0:
        raise UsageError("expected --seeds and --steps of at least 1, and a --seed of at least 0")
    if args.minutes is not None and not args.minutes > 0.0:
        raise UsageError(f"--minutes: expected more than 0, got {args.minutes:g}")
    bench = load_bench()
    measured = replace(bench, sensors=Sensors())  # with white noise, R = diag(1e-6, 1)
    if args.choices:
        return _choices(args, bench, [name for name in names if name in TRAININGS])
    trainings = _trainings(args, bench) if any(name in trained for name in names) else None
    if args.figures is not None:
        return _figures(args.figures, measured, names, trainings)
    facts = [Fact(name, *statement) for name in names if name in ANALYSIS for statement in ANALYSIS[name](measured)]
    if trainings is not None:
        from studies.thesis.agents import agent_facts

        facts += [fact for name in names if name in TRAININGS for fact in agent_facts(name, trainings)]
    if args.json:
        return json.dumps([fact.document() for fact in facts], indent=1, allow_nan=False)
    agreeing, differing = (sum(fact.agrees is said for fact in facts) for said in (True, False))
    count = (
        f"{agreeing} of {len(facts)} statements agree, {differing} do not follow, "
        f"{len(facts) - agreeing - differing} are only suggested"
    )
    return f"{facts_text(facts)}\n\n{count if args.steps is None else 'a rehearsal: no verdict of a training counts'}"


def _trainings(args: argparse.Namespace, bench: Bench) -> Trainings:
    from studies.thesis.choices import set_choice
    from studies.thesis.trainings import Trainings

    seeds = range(args.seed, args.seed + args.seeds)
    return Trainings(args.output, bench, seeds, args.steps, _tell, set_choice(args.set), _end(args))


def _figures(folder: Path, bench: Bench, names: Sequence[str], trainings: Trainings | None) -> str:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as err:
        raise UsageError(f"--figures {folder}: {err.strerror}") from err
    files = [folder / f"{name}.png" for name in names]
    for name, path in zip(names, files, strict=True):
        if name in pictures.ANALYSIS:
            pictures.ANALYSIS[name](bench, path, name)
        elif trainings is not None:
            pictures.draw_trained(trainings, path, name)
    return "\n".join(map(str, files))


def _choices(args: argparse.Namespace, bench: Bench, figures: Sequence[str]) -> str:
    from studies.thesis.choices import compared, document, text

    if not figures or args.set or args.figures is not None:
        raise UsageError("--choices: expected figures or tables of trainings, no --set and no --figures")
    seeds = range(args.seed, args.seed + args.seeds)
    counts = compared(args.output, bench, figures, seeds, args.steps, _tell, _end(args))
    return json.dumps(document(counts), indent=1) if args.json else text(counts)


def _end(args: argparse.Namespace) -> float:
    """Time of :func:`time.monotonic` from which no training begins [s]."""
    return math.inf if args.minutes is None else time.monotonic() + 60.0 * args.minutes


def _tell(what: str) -> None:
    mention(f"{PROGRAM}: {what}")


if __name__ == "__main__":
    sys.exit(main())
