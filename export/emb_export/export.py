"""``emb-export``: currents, or a network of others, as one ONNX file with a contract.

What needs the extra is imported inside functions, so that ``--help`` is quick and a missing extra is one line.
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
from emb_runtime.safety.shield_design import make_law
from emb_runtime.system.input_file import near_file
from emb_runtime.system.terminal import Parser, complain, show

EPILOG = """\
sequences:
{sequences}

example:
  emb-export chirp:f1=20,amplitude=0.5 -o chirp.onnx
  emb-export mine.onnx -o actor.onnx && emb-run --policy actor.onnx

exit codes: 0 done, 2 usage, 5 the network is refused, or the exported file does not compute what it was made of,
130 Ctrl-C: nothing is written
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    sequences = f"  {', '.join(EXCITATIONS)}"
    p = Parser(
        prog="emb-export",
        description="Write a policy for emb-run as one ONNX file with its contract, and check that the file computes\n"
        "the same as its source: currents, a design, or a network of your own.",
        epilog=EPILOG.format(sequences=sequences),
    )
    p.add_argument(
        "source",
        metavar="EXCITATION|CSV|ONNX",
        help="a sequence: step:amplitude=1.5, chirp:f1=20, ..., the .csv file of emb-design, or your own with the "
        "columns current, or time,current; your network as .onnx: its inputs are angle, velocity and time, with or "
        "without the running estimate; its output is one number",
    )
    p.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the ONNX file")
    p.add_argument(
        "--kind",
        choices=tuple(UNITS),
        help="output of your network: a current [A], or a target speed [rad/s] which the runtime's speed loop follows "
        "(default: current)",
    )
    p.add_argument(
        "--bench",
        type=Path,
        metavar="FILE",
        help="bench file of the policy's bench (default: the shipped drum brake)",
    )
    return p


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    arguments = parser().parse_args(argv)
    try:
        with needs("an export", "bench"):
            show(_export(arguments))
    except EmbError as err:
        return complain("emb-export", err)
    return EXIT_DONE


def _export(arguments: argparse.Namespace) -> str:
    source, path = Path(arguments.source), arguments.output
    is_graph = source.suffix.lower() == ".onnx"
    if arguments.kind and not is_graph:
        raise UsageError(f"--kind {arguments.kind}: is for a network as .onnx; a sequence has its own: leave it out")
    require_place("--output", path, (".onnx",))
    from emb_bench.export.own_policy import onnx_policy
    from emb_bench.export.policy_file import sequence_file
    from emb_bench.export.sequence import read_sequence

    bench = load_bench(arguments.bench)
    make_law(bench)  # where no shield can be made, emb-run would refuse the bench
    if is_graph:
        data, what = onnx_policy(source, bench, arguments.kind or "current")
    elif (name := arguments.source.partition(":")[0]) not in EXCITATIONS and source.suffix.lower() != ".csv":
        trained = source / "actor.onnx"
        hint = f"; emb-run takes {trained} as it is" if trained.exists() else near(name, EXCITATIONS)
        hint = hint or near_file(source)
        raise UsageError(f"{source}: expected a sequence (emb-export --help lists them), a .csv or an .onnx{hint}")
    else:
        currents, what = read_sequence(arguments.source, bench)
        data = sequence_file(currents, what, bench)
    with replacing(path) as beside:
        beside.write_bytes(data)
    return f"{path}: {len(data)} bytes, compared with {what}"


if __name__ == "__main__":
    sys.exit(main())
