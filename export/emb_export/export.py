"""``emb-export``: a training's actor, or a sequence of currents, as one ONNX file under the contract.

What needs torch is imported inside functions, so that ``--help`` is quick and a missing extra is one line.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from emb_bench.excitation.reference import EXCITATIONS
from emb_runtime.config.bench import load_bench
from emb_runtime.errors import EXIT_DONE, EmbError, UsageError
from emb_runtime.safety.shield_design import make_law
from emb_runtime.system.terminal import complain, show
from emb_train.names import reference_names, wrapped

if TYPE_CHECKING:
    from emb_runtime.config.bench import Bench
    from emb_train.training import Trained

WORST_CASE = "worst case"  # The kind of shield that a bench has: for all of its set, whatever is believed of the brake

EPILOG = """\
sequences:
{sequences}

tuned references for the structured actor:
{references}

exit codes: 0 done, 2 usage, 5 the exported file does not compute what the trained network computes,
130 Ctrl-C: nothing is written
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog="emb-export",
        description="Export the actor of a training as one ONNX file with its contract, and prove both equal. Or a "
        "reference excitation, an optimal design, or a structured actor with its running estimate, so that emb-run "
        "plays it behind the same shield and guard.",
        epilog=EPILOG.format(sequences=wrapped(list(EXCITATIONS)), references=wrapped(reference_names())),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument(
        "source",
        metavar="DIR|EXCITATION|DESIGN|STRUCTURED",
        help="directory that emb-train wrote; or a sequence: step:amplitude=1.5, chirp:f1=20, ..., or the .npz file of "
        "emb-design; or a tuned reference for the structured actor, one of those below or the .json file of emb-train "
        "tune",
    )
    p.add_argument("--out", type=Path, metavar="FILE", help="the ONNX file (default: DIR/actor.onnx, without --bench)")
    p.add_argument(
        "--bench",
        type=Path,
        metavar="FILE",
        help="bench that it is for (default: for a training the one that it was trained on, else the shipped drum "
        "brake); its shield may be another one than in a training, its limits, noise and timing may not",
    )
    return p


class Exported(NamedTuple):
    """An actor as a file."""

    data: bytes  # Its bytes
    difference: float  # Largest difference of its current from the actor's in torch, as a part of the current limit
    said: str  # Notes on it for the user; starts with a comma or a semicolon, or is empty


def export(directory: Path, bench_file: Path | None = None) -> Exported:
    """Export what was trained.

    Args:
        directory: of the training.
        bench_file: bench that the file is for, see :func:`emb_train.bench_compatibility.require_alike`; the
        training's without.

    Raises:
        UsageError: the directory holds no usable training, or the bench is none for its actor.
        BenchFileError: the bench file is not valid.
        PolicyRefusedError: the file would be refused by the runtime, or differs from the network.
    """
    import numpy as np
    import torch

    from emb_export.file import add_contract, contract_for
    from emb_export.network import graph_of, random_observations, recorded_observations, require_parity, vectors_of
    from emb_runtime.policy.contract import OBSERVATION
    from emb_runtime.policy.inference import INPUT_NAME, OUTPUT_NAME
    from emb_runtime.policy.policy import load_policy
    from emb_train.bench_compatibility import require_alike, require_fit
    from emb_train.envs.conditions import EVERYTHING
    from emb_train.ppo import DeployedActor
    from emb_train.training import load_training

    trained = load_training(directory)
    config, trained_on = trained.training, trained.bench
    if config.conditions.observes == EVERYTHING:
        raise UsageError(
            f"{directory}: this actor sees the parameters and the information, which no bench measures: no run could"
            " give it what it needs"
        )
    bench, ranges = trained_on if bench_file is None else load_bench(bench_file), trained_on.range_set(config.ranges)
    require_alike(trained_on, bench, str(directory))
    require_fit(bench, ranges, str(directory))
    said = (
        f", of iteration {trained.iteration} of {config.ppo.iterations}, which returned {trained.score:.6g} on brakes "
        f"that no training draws{_shield_note(config.conditions.applied(trained_on), bench)}"
    )
    torch.set_num_threads(1)
    actor, provenance = DeployedActor(trained.actor, bench.limits.current), _provenance(trained)
    recorded = recorded_observations(actor, bench, ranges, config.parameters)
    observations = np.concatenate([recorded, random_observations(bench)])
    contract = contract_for(bench, ranges.low, ranges.high, vectors_of(actor, observations), provenance)
    graph = graph_of(actor, (torch.zeros(1, len(OBSERVATION)),), [INPUT_NAME], [OUTPUT_NAME])
    data = add_contract(graph, contract)
    policy = load_policy(data, bench)
    return Exported(data, require_parity(actor, policy, observations), said)


def export_structured(source: str, bench: Bench) -> Exported:
    """Export a structured actor.

    Args:
        source: name of a reference that is part of the package, or a ``.json`` file.
        bench: what it is for.

    Raises:
        UsageError: there is no such reference, the file is something else, or the bench is none for this actor.
        BenchFileError: the bench lacks the ranges or the plant.
        PolicyRefusedError: the runtime would refuse it, or it differs from the module.
    """
    from emb_export.stateful import export_stateful
    from emb_train.bench_compatibility import require_fit
    from emb_train.structured.actor import actor_of
    from emb_train.structured.stored import stored

    kept = stored(source)
    task = kept.asked()
    ranges = bench.range_set(task.ranges)
    require_fit(bench, ranges, source)
    actor = actor_of(kept, bench)
    provenance: dict[str, str | int | float] = {
        "structured": Path(source).stem,
        "summary": f"running estimate, reference '{kept.form}' for {kept.task}",
        "plant": kept.plant,
        "seed": kept.seed,
        "command": kept.command,
        **_versions(),
    }
    said = _shield_note(task.conditions.applied(bench), bench, task.shield)
    return Exported(*export_stateful(actor.eval(), bench, ranges, provenance), said)


def _shield_note(trained: Bench, bench: Bench, kind: str = WORST_CASE) -> str:
    """Note that the actor learned behind another shield than the bench's; empty where both are alike."""
    from emb_train.bench_compatibility import shield_changes

    changes = [shield_changes(trained, bench), f"{kind}, here {WORST_CASE}" if kind != WORST_CASE else ""]
    if not any(changes):
        return ""
    differences = ", ".join(change for change in changes if change)
    return f"; it learned behind another shield ({differences}), and is worth something else behind this one"


def _versions() -> dict[str, str]:
    return {name: version(name) for name in ("emb-excite", "torch", "onnx", "onnxscript", "numpy")}


def _provenance(trained: Trained) -> dict[str, str | int | float]:
    """The configuration, part by part, and what was exported of it; without time and place: the same file each time."""
    import msgspec

    parts = json.loads(msgspec.json.encode(trained.training))
    return {
        **{k: json.dumps(v, separators=(",", ":")) if isinstance(v, dict | list) else v for k, v in parts.items()},
        "steps": trained.iteration * trained.training.ppo.batch,
        "score": trained.score,
        **_versions(),
    }


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
    source, path = Path(arguments.source), arguments.out
    if source.is_dir():
        if arguments.bench and path is None:
            raise UsageError(
                "--bench: expected --out FILE with it, for DIR/actor.onnx is for the bench of the training"
            )
        path, made = path or source / "actor.onnx", export(source, arguments.bench)
        of = f"within {made.difference:.1e} of the trained network{made.said}"
    elif path is None:
        raise UsageError("--out: expected a file to write to")
    elif source.suffix == ".json" or arguments.source in reference_names():
        made = export_structured(arguments.source, load_bench(arguments.bench))
        of = f"within {made.difference:.1e} of the actor in torch{made.said}"
    else:
        made, of = _sequence(arguments.source, load_bench(arguments.bench))
    _write(path, made.data)
    return f"{path}: {len(made.data)} bytes, {of}"


def _sequence(source: str, bench: Bench) -> tuple[Exported, str]:
    from emb_export.file import export_sequence, read_sequence

    make_law(bench)  # where no shield can be made, emb-run would refuse the bench
    currents, what = read_sequence(source, bench)
    return Exported(export_sequence(currents, what, bench), 0.0, ""), what


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
