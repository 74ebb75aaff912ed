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
from emb_runtime.envelope import make_law
from emb_runtime.errors import EXIT_DONE, EmbError, UsageError
from emb_runtime.terminal import complain, show

if TYPE_CHECKING:
    from emb_runtime.bench import Bench
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
        "reference excitation, an optimal design, or a structured actor with its running estimate, so that emb-run "
        "plays it behind the same shield and guard.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument(
        "source",
        metavar="DIR|EXCITATION|DESIGN|STRUCTURED",
        help="directory that emb-train wrote; or a sequence: step:amplitude=1.5, chirp:f1=20, ... (the names are those "
        "of emb-replay compare), or the .npz file of emb-design; or a tuned reference for the structured actor, "
        "four-d-speed or the .json file of emb_train.structured.tune",
    )
    p.add_argument("--out", type=Path, metavar="FILE", help="the ONNX file (default: DIR/actor.onnx)")
    p.add_argument(
        "--bench",
        type=Path,
        metavar="FILE",
        help="bench that a sequence or a structured actor is for (default: the shipped drum brake)",
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
    from emb_train.conditions import EVERYTHING
    from emb_train.networks import DeployedActor

    config, bench, trained, progress = load_actor(directory)
    if config.conditions.observes == EVERYTHING:
        raise UsageError(
            f"{directory}: this actor sees the parameters and the information, which no bench measures: no run could"
            " give it what it needs"
        )
    torch.set_num_threads(config.ppo.threads)
    actor = DeployedActor(trained, bench.limits.current)
    ranges = bench.range_set(config.ranges)
    recorded = recorded_observations(actor, bench, ranges, config.parameters)
    observations = np.concatenate([recorded, random_observations(bench)])
    contract = make_contract(actor, bench, ranges, observations, _provenance(config, progress))
    data = add_contract(export_graph(actor), contract)
    policy = load_policy(data, bench)
    return data, require_parity(actor, policy, observations)


def export_structured(source: str, bench: Bench) -> tuple[bytes, float]:
    """The file of a structured actor, and how far it is from the module, as a part of the current limit.

    Args:
        source: name of a reference that is part of the package, or a ``.json`` file.
        bench: what it is for.

    Raises:
        UsageError: there is no such reference, or the file is something else.
        BenchFileError: the bench lacks the ranges or the plant.
        PolicyRefusedError: the runtime would refuse it, or it differs from the module.
    """
    from emb_export.stateful import export_stateful
    from emb_train.structured.actor import actor_of
    from emb_train.structured.stored import read_file, stored

    kept = read_file(Path(source)) if Path(source).suffix == ".json" else stored(source)
    actor = actor_of(kept, bench)
    provenance: dict[str, str | int | float] = {
        "structured": Path(source).stem,
        "summary": f"running estimate, reference '{kept.form}' for {kept.task}",
        "plant": kept.plant,
        "seed": kept.seed,
        "command": kept.command,
        **_versions(),
    }
    return export_stateful(actor.eval(), bench, bench.range_set(kept.asked().ranges), provenance)


def _versions() -> dict[str, str]:
    return {name: version(name) for name in ("emb-excite", "torch", "onnx", "onnxscript", "numpy")}


def _provenance(config: Configuration, progress: Progress) -> dict[str, str | int | float]:
    """How the actor came to be: nothing of when and where, so that the same training gives the same file."""
    return {
        "preset": config.preset,
        "summary": config.summary,
        "seed": config.seed,
        "steps": progress.iteration * config.ppo.batch,
        **_recipe(config, progress),
        **_versions(),
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
    if not is_sequence and not directory.is_dir() and (directory.suffix == ".json" or _is_structured(name)):
        path = _out(arguments.out)
        data, difference = export_structured(arguments.source, load_bench(arguments.bench))
        _write(path, data)
        return f"{path}: {len(data)} bytes, within {difference:.1e} of the actor in torch"
    # A directory may have a colon in its name; what is none and has one can only be meant as an excitation.
    if not is_sequence and (not options or directory.is_dir()):
        if arguments.bench is not None:
            raise UsageError("--bench: a trained actor is for the bench that it was trained on; leave it out")
        path = arguments.out or directory / "actor.onnx"
        data, difference = export(directory)
        _write(path, data)
        return f"{path}: {len(data)} bytes, within {difference:.1e} of the trained network"
    path = _out(arguments.out)
    from emb_export.sequence import export_sequence, read_sequence

    bench = load_bench(arguments.bench)
    make_law(bench)  # where no shield can be made, emb-run would refuse the bench
    currents, what = read_sequence(arguments.source, bench)
    data = export_sequence(currents, what, bench)
    _write(path, data)
    return f"{path}: {len(data)} bytes, {what}"


def _is_structured(name: str) -> bool:
    from emb_train.structured.stored import stored_names

    return name in stored_names()


def _out(path: Path | None) -> Path:
    if path is None:
        raise UsageError("--out: expected a file to write to")
    return path


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
