"""``emb-train reproduce``: the thesis's trainings, tables and figures anew."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from emb_runtime.bench import load_bench
from emb_runtime.errors import EXIT_DONE, EmbError, UsageError
from emb_runtime.terminal import complain, show

if TYPE_CHECKING:
    from emb_train.reproduce.result import Result
    from emb_train.reproduce.trainings import Trainings

PROGRAM = "emb-train reproduce"
EXIT_INTERRUPTED = 130
TARGETS = (
    "fig-5.2",
    "fig-5.3",
    "fig-5.4",
    "fig-5.5",
    "fig-5.6",
    "fig-5.7",
    "fig-5.8",
    "table-5.1",
    "fig-5.9",
    "fig-6.1",
    "fig-6.2",
    "fig-6.3",
    "table-6.2",
)
SEEDS = 5
"""As many as the thesis has in Fig. 5.9."""

EPILOG = """\
Trainings are kept in DIR/trainings: one that is there is not repeated, one that was interrupted goes on. The results
are DIR/reproduction.md, DIR/reproduction.json and a PNG for each target. Table 5.1, Fig. 5.9 and Table 6.2 take all
seeds, the others the first.

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
    p.add_argument("target", nargs="*", metavar="TARGET", help=f"all (the default), or some of {', '.join(TARGETS)}")
    p.add_argument("--out", type=Path, metavar="DIR", default=Path("reproduction"), help="default: %(default)s")
    p.add_argument("--steps", type=int, metavar="N", help="environment steps of a training, at most (default: all)")
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
        sys.stderr.write(f"{PROGRAM}: interrupted; the same command goes on\n")
        return EXIT_INTERRUPTED
    return EXIT_DONE


def _reproduce(arguments: argparse.Namespace, command: str) -> str:
    from emb_train.reproduce.report import MARKDOWN, Made, summary, write_report
    from emb_train.reproduce.trainings import Trainings

    unknown = [name for name in arguments.target if name not in (*TARGETS, "all")]
    if unknown:
        raise UsageError(f"no table or figure is called '{unknown[0]}'; there are: all, {', '.join(TARGETS)}")
    for name in ("steps", "seeds"):
        if getattr(arguments, name) is not None and getattr(arguments, name) < 1:
            raise UsageError(f"--{name}: expected at least 1, got {getattr(arguments, name)}")
    asked = arguments.target or ["all"]
    names = TARGETS if "all" in asked else tuple(name for name in TARGETS if name in asked)
    folder: Path = arguments.out
    try:
        (folder / "trainings").mkdir(parents=True, exist_ok=True)
    except OSError as err:
        raise UsageError(f"{folder}: cannot make this folder: {err.strerror}") from err
    seeds = range(arguments.seed, arguments.seed + arguments.seeds)
    trainings = Trainings(folder / "trainings", load_bench(), seeds, arguments.steps, _tell)
    results = [_figures()[name](trainings, folder / f"{name}.png") for name in names]
    made = Made(command, trainings.seeds, arguments.steps, trainings.steps, trainings.seconds)
    write_report(folder, made, results)
    return f"{summary(results)}: {folder / MARKDOWN}"


def _tell(what: str) -> None:
    sys.stderr.write(f"{PROGRAM}: {what}\n")


def _figures() -> dict[str, Callable[[Trainings, Path], Result]]:
    from emb_train.reproduce import several, single

    makers = (
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
    return dict(zip(TARGETS, makers, strict=True))
