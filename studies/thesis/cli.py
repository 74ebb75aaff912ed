"""``python -m studies.thesis``: what the thesis prints about its analysis figures, computed anew, with a verdict."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from importlib import metadata

from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.errors import EXIT_DONE, EmbError, UsageError
from emb_runtime.system.terminal import complain, show
from studies.thesis import determinant, oscillator, two_parameters
from studies.thesis.determinant_facts import protected_facts, unprotected_facts
from studies.thesis.facts import Fact, facts_text

PROGRAM = "python -m studies.thesis"
EPILOG = """\
Each statement of the thesis gets a verdict: 'agrees' or 'does not follow' (from its own equations), or 'only
suggested' where the thesis says no more than that it is possible, with our number. The brake is the thesis's (Table
4.1), under Euler, the Fisher information the weighted one. docs/studies/thesis.md explains what does not follow.
python -m studies.thesis.training makes the thesis's trainings, their figures and tables.

exit codes: 0 done, whatever the verdicts are; 2 usage
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Check what is printed about the analysis figures of Guo (TU Darmstadt, 2024).",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--version", action="version", version=f"{PROGRAM} {metadata.version('emb-excite')}")
    p.add_argument("figure", nargs="?", default="all", choices=(*_FIGURES, "all"), help="which (default: %(default)s)")
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
    facts = [fact for name in names for fact in _FIGURES[name](bench, args.amplitude, args.epsilon)]
    if args.json:
        return json.dumps([fact.document() for fact in facts], indent=1, allow_nan=False)
    agreeing, differing = (sum(fact.agrees is said for fact in facts) for said in (True, False))
    return (
        f"{facts_text(facts)}\n\n{agreeing} of {len(facts)} statements agree with the thesis's equations, {differing} "
        f"do not follow, {len(facts) - agreeing - differing} are only suggested there"
    )


def _fig_4_2(bench: Bench, amplitude: float, _epsilon: float) -> list[Fact]:
    strongest = determinant.unprotected(bench, bench.limits.current)
    return unprotected_facts(determinant.unprotected(bench, amplitude), strongest)


def _fig_4_3(bench: Bench, amplitude: float, epsilon: float) -> list[Fact]:
    return protected_facts(determinant.unprotected(bench, amplitude), determinant.protected(bench, amplitude, epsilon))


def _fig_5_1(bench: Bench, _amplitude: float, _epsilon: float) -> list[Fact]:
    return oscillator.oscillator_facts(bench)


def _sec_6_1(bench: Bench, _amplitude: float, _epsilon: float) -> list[Fact]:
    runs = [two_parameters.excited(bench, name) for name in two_parameters.EXCITATIONS]
    return two_parameters.two_parameter_facts(bench, runs)


_FIGURES: dict[str, Callable[[Bench, float, float], list[Fact]]] = {
    "fig-4.2": _fig_4_2,
    "fig-4.3": _fig_4_3,
    "fig-5.1": _fig_5_1,
    "sec-6.1": _sec_6_1,
}


if __name__ == "__main__":
    sys.exit(main())
