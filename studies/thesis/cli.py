"""``python -m studies.thesis``: the analysis figures of the thesis, computed anew, and a verdict on each fact."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path

from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.errors import EXIT_DONE, EmbError, UsageError
from emb_runtime.system.terminal import complain, show
from studies.thesis import determinant, oscillator, plots, two_parameters
from studies.thesis.determinant_facts import protected_facts, unprotected_facts
from studies.thesis.facts import Fact, facts_text

PROGRAM = "python -m studies.thesis"
EPILOG = """\
Each statement of the thesis gets a verdict: 'agrees' or 'does not follow' (from its own equations), or 'only
suggested' where the thesis says no more than that it is possible, with our number.
The figures and facts.json are written into DIR. The brake is the thesis's (Table 4.1), under Euler, the Fisher
information the weighted one. docs/studies/thesis.md explains what does not follow.

exit codes:
  0  done, whatever the verdicts are
  2  usage: wrong argument, DIR cannot be written, matplotlib missing
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Compute the analysis figures of Guo (TU Darmstadt, 2024) anew and check what is printed about "
        "them.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--version", action="version", version=f"{PROGRAM} {metadata.version('emb-excite')}")
    p.add_argument("figure", nargs="?", default="all", choices=(*_FIGURES, "all"), help="which (default: %(default)s)")
    p.add_argument("--out", type=Path, metavar="DIR", default=Path("thesis"), help="where to (default: %(default)s)")
    p.add_argument("--json", action="store_true", help="print the facts as JSON")
    p.add_argument(
        "--amplitude",
        type=float,
        default=determinant.AMPLITUDE,
        metavar="A",
        help="constant current of Fig. 4.2 and 4.3, which the thesis does not state (default: %(default)g A)",
    )
    p.add_argument(
        "--epsilon",
        type=float,
        default=determinant.EPSILON,
        metavar="E",
        help="start of the Fisher information in Fig. 4.3, not stated either (default: %(default)g)",
    )
    return p


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``python -m studies.thesis``."""
    args = parser().parse_args(argv)
    try:
        show(_run(args))
    except EmbError as err:
        return complain(PROGRAM, err)
    return EXIT_DONE


def _run(args: argparse.Namespace) -> str:
    bench = load_bench()
    limit = bench.limits.current
    if not 0.0 < args.amplitude <= limit:
        raise UsageError(f"--amplitude: expected a current in (0, {limit:g}] A, got {args.amplitude:g}")
    if not 1e-12 <= args.epsilon <= 1.0:
        raise UsageError(f"--epsilon: expected a number from 1e-12 to 1, got {args.epsilon:g}")
    names = tuple(_FIGURES) if args.figure == "all" else (args.figure,)
    folder: Path = args.out
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as err:
        raise UsageError(f"{folder}: cannot make this folder: {err.strerror}") from err
    facts: list[Fact] = []
    for name in names:
        facts += _FIGURES[name](bench, folder / f"{name}.png", args.amplitude, args.epsilon)
    text = json.dumps([fact.document() for fact in facts], indent=1, allow_nan=False)
    try:
        (folder / "facts.json").write_text(text + "\n", encoding="utf-8")
    except OSError as err:
        raise UsageError(f"{folder / 'facts.json'}: cannot write: {err.strerror}") from err
    return text if args.json else f"{facts_text(facts)}\n\n{_summary(facts, names, folder)}"


def _summary(facts: Sequence[Fact], names: Sequence[str], folder: Path) -> str:
    agreeing, differing = (sum(fact.agrees is said for fact in facts) for said in (True, False))
    suggested = len(facts) - agreeing - differing
    written = ", ".join(str(folder / f"{name}.png") for name in names)
    return (
        f"{agreeing} of {len(facts)} statements agree with the thesis's equations, {differing} do not follow, "
        f"{suggested} are only suggested there; written: {written}, {folder / 'facts.json'}"
    )


def _fig_4_2(bench: Bench, path: Path, amplitude: float, _epsilon: float) -> list[Fact]:
    found = determinant.unprotected(bench, amplitude)
    strongest = determinant.unprotected(bench, bench.limits.current)
    plots.plot_unprotected(bench, found, path)
    return unprotected_facts(found, strongest)


def _fig_4_3(bench: Bench, path: Path, amplitude: float, epsilon: float) -> list[Fact]:
    found = determinant.unprotected(bench, amplitude)
    cured = determinant.protected(bench, amplitude, epsilon)
    plots.plot_protected(bench, found, cured, path)
    return protected_facts(found, cured)


def _fig_5_1(bench: Bench, path: Path, _amplitude: float, _epsilon: float) -> list[Fact]:
    plots.plot_oscillator(bench, oscillator.inputs(bench), path)
    return oscillator.oscillator_facts(bench)


def _sec_6_1(bench: Bench, path: Path, _amplitude: float, _epsilon: float) -> list[Fact]:
    runs = [two_parameters.excited(bench, name) for name in two_parameters.EXCITATIONS]
    plots.plot_two_parameters(bench, runs, path)
    return two_parameters.two_parameter_facts(bench, runs)


_FIGURES: dict[str, Callable[[Bench, Path, float, float], list[Fact]]] = {
    "fig-4.2": _fig_4_2,
    "fig-4.3": _fig_4_3,
    "fig-5.1": _fig_5_1,
    "sec-6.1": _sec_6_1,
}


if __name__ == "__main__":
    sys.exit(main())
