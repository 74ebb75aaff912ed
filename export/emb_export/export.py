"""``emb-export``: a training's actor, or a sequence of currents, as one ONNX file under the contract.

What needs torch is imported inside functions, so that ``--help`` is quick and a missing extra is one line.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from emb_bench.excitation import EXCITATIONS
from emb_bench.plant import DEFAULT_PLANT
from emb_runtime.bench import load_bench
from emb_runtime.errors import EXIT_DONE, EmbError, UsageError
from emb_runtime.terminal import complain, show

if TYPE_CHECKING:
    from emb_train.checkpoint import Progress
    from emb_train.configuration import Configuration

EPILOG = """\
exit codes: 0 done, 2 usage, 5 the exported file does not compute what the trained network computes
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog="emb-export",
        description="Export the actor of a training as one ONNX file with its contract, and prove both equal. Or a "
        "reference excitation, or an optimal design, so that emb-run plays it behind the same shield and guard.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument(
        "source",
        metavar="DIR|EXCITATION|DESIGN",
        help="directory that emb-train wrote; or a sequence: step:amplitude=1.5, chirp:f1=20, ... (the names are those "
        "of emb-replay compare), or the .npz file of emb-design",
    )
    p.add_argument("--out", type=Path, metavar="FILE", help="the ONNX file (default: DIR/actor.onnx)")
    p.add_argument(
        "--bench", type=Path, metavar="FILE", help="bench that a sequence is for (default: the shipped drum brake)"
    )
    return p


def export(directory: Path) -> tuple[bytes, float]:
    """The file's bytes and how far it is from the network, as a part of the current limit.

    Raises:
        UsageError: the directory holds no usable training.
        PolicyRefusedError: the file would be refused by the runtime, or differs from the network.
    """
    import numpy as np
    import torch

    from emb_export.file import add_contract
    from emb_export.onnx import export_graph, make_contract
    from emb_export.parity import random_observations, recorded_observations, require_parity
    from emb_runtime.policy import load_policy
    from emb_train.checkpoint import load_actor
    from emb_train.networks import DeployedActor

    config, bench, trained, progress = load_actor(directory)
    torch.set_num_threads(config.ppo.threads)
    actor = DeployedActor(trained, bench.limits.current)
    ranges = bench.range_set(config.ranges)
    recorded = recorded_observations(actor, bench, ranges, config.parameters)
    observations = np.concatenate([recorded, random_observations(bench)])
    contract = make_contract(actor, bench, ranges, observations, _provenance(config, progress))
    data = add_contract(export_graph(actor), contract)
    policy = load_policy(data, bench)
    return data, require_parity(actor, policy, observations)


def _provenance(config: Configuration, progress: Progress) -> dict[str, str | int | float]:
    """How the actor came to be: nothing of when and where, so that the same training gives the same file."""
    return {
        "preset": config.preset,
        "summary": config.summary,
        "seed": config.seed,
        "steps": progress.iteration * config.ppo.batch,
        **_recipe(config, progress),
        **{name: version(name) for name in ("emb-excite", "torch", "onnx", "onnxscript", "numpy")},
    }


def _recipe(config: Configuration, progress: Progress) -> dict[str, str]:
    """The command that makes this actor again, or, where no single command does, what happened."""
    (_, steps), *changes = progress.schedule
    plant = "" if config.plant == DEFAULT_PLANT else f" --plant {config.plant}"
    begun = f"emb-train --preset {config.preset}{plant} --seed {config.seed} --steps {steps} --out DIR"
    iterations = config.ppo.iterations_for(progress.schedule[-1][1])
    if not changes and progress.iteration == iterations:
        return {"command": f"{begun} && emb-export DIR"}
    resumed = "".join(f", resumed at iteration {i} with --steps {n}" for i, n in changes)
    return {"history": f"{begun}{resumed}, exported at iteration {progress.iteration} of {iterations}"}


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    arguments = parser().parse_args(argv)
    try:
        show(_export(arguments))
    except ModuleNotFoundError as err:
        extra = "bench" if err.name == "onnx" else "train"  # enough for a sequence
        return complain("emb-export", UsageError(f"{err.name} is not installed: pip install 'emb-excite[{extra}]'"))
    except EmbError as err:
        return complain("emb-export", err)
    return EXIT_DONE


def _export(arguments: argparse.Namespace) -> str:
    directory = Path(arguments.source)
    name, _, options = arguments.source.partition(":")
    is_sequence = directory.suffix == ".npz" or name.strip() in EXCITATIONS
    # A directory may have a colon in its name; what is none and has one can only be meant as an excitation.
    if not is_sequence and (not options or directory.is_dir()):
        if arguments.bench is not None:
            raise UsageError("--bench: a trained actor is for the bench that it was trained on; leave it out")
        path = arguments.out or directory / "actor.onnx"
        data, difference = export(directory)
        _write(path, data)
        return f"{path}: {len(data)} bytes, within {difference:.1e} of the trained network"
    if arguments.out is None:
        raise UsageError("--out: expected a file to write the sequence to")
    from emb_export.sequence import export_sequence, read_sequence

    bench = load_bench(arguments.bench)
    currents, what = read_sequence(arguments.source, bench)
    data = export_sequence(currents, what, bench)
    _write(arguments.out, data)
    return f"{arguments.out}: {len(data)} bytes, {what}"


def _write(path: Path, data: bytes) -> None:
    if path.is_dir():
        raise UsageError(f"{path}: expected a file to write, got a directory")
    part = path.with_name(path.name + ".part")
    try:
        part.write_bytes(data)
        part.replace(path)
    except OSError as err:
        with contextlib.suppress(OSError):
            part.unlink()
        raise UsageError(f"{path}: cannot write: {err.strerror}") from err


if __name__ == "__main__":
    sys.exit(main())
