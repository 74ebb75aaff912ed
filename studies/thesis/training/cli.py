"""``python -m studies.thesis.training``: the thesis's trainings, tables and figures anew."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from emb_runtime.config.bench import load_bench
from emb_runtime.errors import EXIT_DONE, EXIT_INTERRUPTED, EmbError, UsageError
from emb_runtime.system.terminal import complain, mention, show
from emb_train.names import listed

if TYPE_CHECKING:
    from studies.thesis.training.plots import Picture
    from studies.thesis.training.result import Result
    from studies.thesis.training.trainings import Trainings

PROGRAM = "python -m studies.thesis.training"
TARGETS: Mapping[str, tuple[str, ...]] = {
    "fig-5.2": ("thesis-fixed",),
    "fig-5.3": ("thesis-fixed",),
    "fig-5.4": ("thesis-random",),
    "fig-5.5": ("thesis-fixed", "thesis-random"),
    "fig-5.6": ("thesis-adaptive",),
    "fig-5.7": ("thesis-trajectory-b",),
    "fig-5.8": ("thesis-trajectory-b",),
    "table-5.1": ("thesis-trajectory-a", "thesis-trajectory-b"),
    "fig-5.9": ("thesis-trajectory-b",),
    "fig-6.1": ("thesis-d-optimal-1", "thesis-d-optimal-2"),
    "fig-6.2": ("thesis-e-optimal-trajectory",),
    "fig-6.3": ("thesis-e-optimal-hybrid",),
    "table-6.2": ("thesis-e-optimal-trajectory", "thesis-e-optimal-hybrid"),
}
"""Tables and figures, and the presets whose trainings each takes."""
SEEDS = 5  # Number of seeds of the thesis in Fig. 5.9.

EPILOG = f"""\
tables and figures, and the presets that are trained for them:
{listed({target: ", ".join(presets) for target, presets in TARGETS.items()})}

Trainings are kept in DIR/trainings: one that is there is not repeated. The results
are DIR/reproduction.md, DIR/reproduction.json and a PNG for each target. Table 5.1, Fig. 5.9 and Table 6.2 take all
seeds, the others the first. All of it is 70 million environment steps, with --seeds 1 it is 18 million. With fewer
--steps than a preset has it is a rehearsal: every table and figure, and no verdict.

exit codes: 0 done, whatever agrees; 1 a training diverged; 2 usage; 130 interrupted
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Train what the thesis trained, and make its tables and figures again.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("target", nargs="*", metavar="TARGET", help="all (the default), or some of those below")
    p.add_argument(
        "--out", type=Path, metavar="DIR", default=Path("reproduction"), help="what is made (default: %(default)s)"
    )
    p.add_argument("--steps", type=int, metavar="N", help="most steps of a training (default: as its preset has)")
    p.add_argument("--seeds", type=int, metavar="N", default=SEEDS, help="trainings of one kind (default: %(default)s)")
    p.add_argument("--seed", type=int, metavar="S", default=0, help="the first seed (default: %(default)s)")
    return p


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    argv = sys.argv[1:] if argv is None else argv
    arguments = parser().parse_args(argv)
    try:
        show(_reproduce(arguments, " ".join([PROGRAM, *argv])))
    except ModuleNotFoundError as err:
        return complain(PROGRAM, UsageError(f"{err.name} is not installed: pip install 'emb-excite[train]'"))
    except EmbError as err:
        return complain(PROGRAM, err)
    except KeyboardInterrupt:
        mention(f"{PROGRAM}: interrupted; remove the training that it was making")
        return EXIT_INTERRUPTED
    return EXIT_DONE


def _reproduce(arguments: argparse.Namespace, command: str) -> str:
    from studies.thesis.training.plots import Picture
    from studies.thesis.training.report import MARKDOWN, Made, summary, write_report
    from studies.thesis.training.trainings import Trainings

    unknown = [name for name in arguments.target if name not in (*TARGETS, "all")]
    if unknown:
        raise UsageError(f"no table or figure is called '{unknown[0]}'; there are: all, {', '.join(TARGETS)}")
    for name, value, least in (
        ("steps", arguments.steps, 1),
        ("seeds", arguments.seeds, 1),
        ("seed", arguments.seed, 0),
    ):
        if value is not None and value < least:
            raise UsageError(f"--{name}: expected at least {least}, got {value}")
    asked = arguments.target or ["all"]
    names = [name for name in TARGETS if name in asked or "all" in asked]
    folder: Path = arguments.out
    try:
        (folder / "trainings").mkdir(parents=True, exist_ok=True)
    except OSError as err:
        raise UsageError(f"{folder}: cannot make this folder: {err.strerror}") from err
    seeds = range(arguments.seed, arguments.seed + arguments.seeds)
    trainings = Trainings(folder / "trainings", load_bench(), seeds, arguments.steps, _tell)
    results = []
    for name in names:
        cut = trainings.cut(TARGETS[name])
        note = f"rehearsal: trainings cut at {arguments.steps:,} steps, no verdict counts" if cut else ""
        result = makers()[name](trainings, Picture(folder / f"{name}.png", note))
        results.append(replace(result, note=note))
    made = Made(command, trainings.seeds, trainings.made)
    write_report(folder, made, results)
    return f"{summary(results)}: {folder / MARKDOWN}"


def _tell(what: str) -> None:
    mention(f"{PROGRAM}: {what}")


def makers() -> dict[str, Callable[[Trainings, Picture], Result]]:
    """Returns the function that makes each of :data:`TARGETS`."""
    from studies.thesis.training import several, single

    functions = (
        single.fig_5_2,
        single.fig_5_3,
        single.fig_5_4,
        single.fig_5_5,
        single.fig_5_6,
        single.fig_5_7,
        single.fig_5_8,
        single.table_5_1,
        single.fig_5_9,
        several.fig_6_1,
        several.fig_6_2,
        several.fig_6_3,
        several.table_6_2,
    )
    return dict(zip(TARGETS, functions, strict=True))
