"""``emb-export``: currents, a training's actor, or a network of others, as one ONNX file with a contract.

What needs torch is imported inside functions, so that ``--help`` is quick and a missing extra is one line.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from emb_bench.config.bench import load_bench
from emb_bench.excitation import EXCITATIONS
from emb_bench.output import replacing, require_place
from emb_runtime.errors import EXIT_DONE, EmbError, UsageError, near, needs
from emb_runtime.policy.contract import UNITS
from emb_runtime.policy.trial import admit_policy
from emb_runtime.safety.shield_design import make_law
from emb_runtime.system.input_file import near_file
from emb_runtime.system.terminal import Parser, complain, show
from emb_train.presets import wrapped

EPILOG = """\
sequences:
{sequences}

example:
  emb-export chirp:f1=20,amplitude=0.5 -o chirp.onnx
  emb-export mine.onnx -o actor.onnx && emb-run --iface sim --policy actor.onnx

exit codes: 0 done, 2 usage, 5 the network is refused, or the exported file does not compute what it was made of,
130 Ctrl-C: nothing is written
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = Parser(
        prog="emb-export",
        description="Write a policy for emb-run as one ONNX file with its contract, and check that the file computes\n"
        "the same as its source: currents, a design, the actor of a training, or a network of your own.",
        epilog=EPILOG.format(sequences=wrapped(list(EXCITATIONS))),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument(
        "source",
        metavar="EXCITATION|CSV|ONNX|DIR",
        help="a sequence: step:amplitude=1.5, chirp:f1=20, ..., the .csv file of emb-design, or your own with the "
        "columns current, or time,current; your network as .onnx: one number for angle, velocity and time, or for "
        "these and the running estimate; or a directory that emb-train wrote",
    )
    p.add_argument("-o", "--output", type=Path, metavar="FILE", help="the ONNX file (default: DIR/actor.onnx)")
    p.add_argument(
        "--kind",
        choices=tuple(UNITS),
        help="what your network gives: a current [A], or a target speed [rad/s] which the runtime's speed loop follows "
        "(default: current)",
    )
    p.add_argument(
        "--bench",
        type=Path,
        metavar="FILE",
        help="bench that it is for (default: the shipped drum brake); a training has its own",
    )
    return p


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    arguments = parser().parse_args(argv)
    try:
        with needs("an export", "train"):
            show(_export(arguments))
    except EmbError as err:
        return complain("emb-export", err)
    return EXIT_DONE


def _export(arguments: argparse.Namespace) -> str:
    source, path = Path(arguments.source), arguments.output
    is_training = source.is_dir()
    if is_training and arguments.bench:
        raise UsageError("--bench: a training's actor is for the bench that it was trained on; leave it out")
    is_graph = not is_training and source.suffix.lower() == ".onnx"
    if arguments.kind and not is_graph:
        what = "a training knows its own" if is_training else "a sequence has its own"
        raise UsageError(f"--kind {arguments.kind}: is for a network as .onnx; {what}: leave it out")
    if path is None and not is_training:
        raise UsageError(f"{source} is no folder of a training: name the file to write, as in --output actor.onnx")
    path = path or source / "actor.onnx"
    require_place("--output", path, (".onnx",))
    if is_training:
        data, what = admit_policy(source / "actor.onnx", load_bench(source / "bench.toml")).data, "its test vectors"
    else:
        with needs("an export", "bench"):
            from emb_bench.export.own_policy import onnx_policy
            from emb_bench.export.policy_file import sequence_file
            from emb_bench.export.sequence import read_sequence

        bench = load_bench(arguments.bench)
        make_law(bench)  # where no shield can be made, emb-run would refuse the bench
        if is_graph:
            data, what = onnx_policy(source, bench, arguments.kind or "current")
        elif (name := arguments.source.partition(":")[0]) not in EXCITATIONS and source.suffix.lower() != ".csv":
            hint = near(name, EXCITATIONS) or near_file(source)
            named = "a sequence (emb-export --help lists them)"
            raise UsageError(f"{source}: expected {named}, a .csv, an .onnx or a folder of emb-train{hint}")
        else:
            currents, what = read_sequence(arguments.source, bench)
            data = sequence_file(currents, what, bench)
    with replacing(path) as beside:
        beside.write_bytes(data)
    return f"{path}: {len(data)} bytes, compared with {what}"


if __name__ == "__main__":
    sys.exit(main())
