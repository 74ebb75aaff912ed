"""Command line of the comparison: ``python -m studies.comparison``."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import textwrap
import time
from pathlib import Path

from emb_bench.cli.estimate import at_least
from emb_bench.excitation.reference import EXCITATIONS, parameters_of
from emb_bench.experiment.evaluation import names_of
from emb_bench.output import reported_if_interrupted
from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.config.plants import DEFAULT_PLANT, Instruments
from emb_runtime.errors import EXIT_DONE, EmbError, UsageError
from emb_runtime.system.terminal import as_json, complain, show

PROGRAM = "python -m studies.comparison"
EXIT_CODES = """\
exit codes:
  0    done
  2    usage: wrong argument, a file that cannot be read or written, a missing library
  5    an actor is damaged or does not fit the bench
  130  Ctrl-C: nothing is written
"""
BRAKES = 20
DRAWS = 4
DESCRIPTION = """\
Play excitations on many simulated brakes, estimate the parameters from every run, and say which excitation is worth it:
by information, by how wrong the estimates really are, by the limits, by the time. All play on the same brakes with the
same noise, behind the envelope shield that the runtime uses, and once on each brake without it. A run that leaves the
limits is stopped there, as on the bench, and nothing is estimated from it.

Each EXCITATION is a text such as chirp:f1=80, 'actor' (the shipped one), 'optimal' (D-optimal for the nominal brake,
searched for now), an actor POLICY.onnx, or a DESIGN.npz of emb-design. The first is what the others are compared with.
Without any, the shipped actor meets ten others.
"""


def parser() -> argparse.ArgumentParser:
    """Returns the command line."""
    p = argparse.ArgumentParser(
        prog=PROGRAM,
        description=DESCRIPTION,
        epilog=f"{choices(load_bench())}\n{EXIT_CODES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("excitations", nargs="*", metavar="EXCITATION", help="who takes part")
    p.add_argument("--brakes", type=int, default=BRAKES, metavar="N", help="drawn at random (default: %(default)s)")
    p.add_argument(
        "--draws", type=int, default=DRAWS, metavar="N", help="of the noise, on each brake (default: %(default)s)"
    )
    p.add_argument("--ranges", metavar="NAME", help="where brakes are drawn from (default: the shield's)")
    p.add_argument(
        "--plant",
        default=DEFAULT_PLANT,
        metavar="NAMES",
        help="how the brakes move, such as exact,stribeck,load (default: %(default)s)",
    )
    p.add_argument("--model", default=DEFAULT_PLANT, metavar="NAME", help="to estimate with (default: %(default)s)")
    p.add_argument("--params", metavar="NAMES", help="what to estimate (default: what varies in the ranges)")
    p.add_argument(
        "--known",
        type=int,
        default=0,
        metavar="N",
        help="search the optimum for the known brake on the first N brakes, seconds each (default: %(default)s)",
    )
    p.add_argument("--seed", type=int, default=0, metavar="N", help="of brakes and noise (default: %(default)s)")
    p.add_argument("--jobs", type=int, metavar="N", help="processes (default: one for each processor)")
    p.add_argument("--bench", type=Path, metavar="FILE", help="bench description (default: the shipped one)")
    p.add_argument(
        "-o", "--out", type=Path, metavar="DIR", help="write comparison.md, comparison.json and comparison.png there"
    )
    p.add_argument("--json", action="store_true", help="print JSON; a number that is not finite is null")
    return p


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``python -m studies.comparison``."""
    args = parser().parse_args(argv)
    try:
        return run(args)
    except EmbError as err:
        return complain(PROGRAM, err)


def choices(bench: Bench) -> str:
    """Returns the names for the command line: excitations with their parameters and defaults, plants and ranges."""
    width = max(map(len, EXCITATIONS)) + 2
    lines = ["excitations, NAME or NAME:PARAMETER=NUMBER,..., with what the shipped bench gives where nothing is said:"]
    for name in EXCITATIONS:
        taken = [f"{p.name}={p.default:g} {p.unit}".rstrip() for p in parameters_of(name, bench)]
        lines.append(f"  {name:{width}}{', '.join(taken)}")
    played = [name for name, plant in bench.plants.items() if plant.instruments == Instruments()]
    for title, names in (("plants and models", played), ("ranges", bench.ranges)):
        lines += ["", f"{title} of the shipped bench:"]
        lines += textwrap.wrap(", ".join(names), 110, initial_indent="  ", subsequent_indent="  ")
    return "\n".join([*lines, "", "emb-run --write-bench FILE writes that bench, where each is defined.", ""])


def run(args: argparse.Namespace) -> int:
    """Compare; tables for a person, or with ``--json`` for a program. Gives the exit code.

    Raises:
        UsageError: a wrong argument or file, or scipy, numba or matplotlib is missing.
        PolicyRefusedError: an actor does not fit the bench.
    """
    jobs = (os.cpu_count() or 1) if args.jobs is None else args.jobs
    at_least(
        {
            "--brakes": (args.brakes, 2),
            "--draws": (args.draws, 1),
            "--known": (args.known, 0),
            "--seed": (args.seed, 0),
            "--jobs": (jobs, 1),
        }
    )
    try:
        import numba  # noqa: F401

        from studies.comparison.candidates import DEFAULT, read_candidates
        from studies.comparison.comparison import ComparisonPlan, compare, varied
        from studies.comparison.report import document, markdown, text
    except ImportError as err:
        raise UsageError(f"{PROGRAM} needs scipy and numba: pip install 'emb-excite[bench]'") from err
    bench = load_bench(args.bench)
    ranges = args.ranges or bench.shield.ranges
    params = varied(bench, ranges) if args.params is None else names_of(args.params)
    plants = names_of(args.plant)
    asked = ComparisonPlan(params, ranges, plants, args.model, args.brakes, args.draws, args.known, args.seed)
    asked.check(bench)
    folder = _folder(args.out)
    begun = time.monotonic()
    with reported_if_interrupted(PROGRAM):
        candidates = read_candidates(args.excitations or DEFAULT, bench, params)
        # To the error stream, because standard output is for the result alone.
        size = f"{len(candidates)} excitations on {asked.brakes} brakes, {asked.draws} draws each"
        sys.stderr.write(f"{PROGRAM}: {size}, {jobs} processes\n")
        sys.stderr.flush()
        found = compare(bench, asked, candidates, jobs)
    seconds = time.monotonic() - begun
    if folder is not None:
        from studies.comparison.figure import draw

        command = _command(args, asked.ranges, params, [c.name for c in candidates])
        _write(folder / "comparison.md", markdown(found, command, seconds, jobs))
        _write(folder / "comparison.json", as_json({"command": command, "seconds": seconds, **document(found)}) + "\n")
        draw(found, folder / "comparison.png")
    show(as_json(document(found)) if args.json else text(found))
    return EXIT_DONE


def _command(args: argparse.Namespace, ranges: str, params: tuple[str, ...], names: list[str]) -> str:
    """Returns the command line that gives the same numbers again."""
    words = [*PROGRAM.split(), *(args.excitations or names)]
    words += ["--brakes", str(args.brakes), "--draws", str(args.draws), "--ranges", ranges, "--plant", args.plant]
    words += ["--model", args.model, "--params", ",".join(params), "--known", str(args.known), "--seed", str(args.seed)]
    return shlex.join(words)


def _folder(path: Path | None) -> Path | None:
    """Complain before the work, not after it."""
    if path is not None:
        if path.suffix and not path.is_dir():
            raise UsageError(f"-o {path}: expected a folder, and a name with an ending is a file's: -o {path.stem}")
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as err:
            raise UsageError(f"-o {path}: cannot be a folder to write to: {err.strerror}") from err
    return path


def _write(path: Path, content: str) -> None:
    try:
        path.write_text(content, encoding="utf-8")
    except OSError as err:
        raise UsageError(f"-o {path}: cannot be written: {err.strerror}") from err
