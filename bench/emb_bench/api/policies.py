"""Own policies as files for ``emb-run``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from emb_bench.api.arguments import is_row
from emb_bench.config.bench import Bench, load_bench
from emb_bench.experiment.experiment import planned
from emb_bench.output import replacing, require_place
from emb_runtime.errors import UsageError, needs
from emb_runtime.policy.contract import UNITS
from emb_runtime.safety.shield_design import make_law


def export_policy(policy: Any, output: str | Path, *, bench: str | Path | None = None, kind: str = "current") -> str:
    """Write a policy for ``emb-run`` as one ONNX file with its contract, and check that it computes the same.

    Outputs beyond the bench's limit are clipped, as stated in the description.

    Args:
        policy: an ONNX file, or a torch module, or a function of a tensor: one number, shape [N, 1], for angle,
            velocity and time, shape [N, 3], or for these and the running estimate, shape [N, 11]; a model of
            Stable-Baselines3 that was trained on ``EmbExcitation-v0``; currents [A], one per sample period; a CSV file
            or an excitation, as for ``emb-export``.
        output: ONNX file to write.
        bench: bench file that it is for (default: the shipped one).
        kind: of the number that a network gives: ``current`` [A], or ``speed``, a target speed [rad/s] which the
            runtime's speed loop follows. A model's action of 1 is the bench's limit of it.

    Returns:
        A description of what it was compared with.

    Raises:
        UsageError: an argument is wrong, a library is missing, or the file cannot be written.
        PolicyRefusedError: the policy is none that ``emb-run`` would take, or the file would differ from it.
    """
    path, its = Path(output), load_bench(bench)
    require_place("output", path, (".onnx",))
    if kind not in UNITS:
        raise UsageError(f"kind: expected {' or '.join(UNITS)}, got {kind!r:.40}")
    make_law(its)  # where no shield can be made, emb-run would refuse the bench
    if not isinstance(policy, str | Path) and (callable(policy) or hasattr(policy, "policy")):
        with needs("an export of a network", "train"):
            from emb_bench.export.torch_policy import module_policy

            data, what = module_policy(policy, its, kind)
    else:
        data, what = _file_of(policy, its, kind)
    with replacing(path) as beside:
        beside.write_bytes(data)
    return f"{path}: {len(data)} bytes, compared with {what}"


def _file_of(policy: Any, bench: Bench, kind: str) -> tuple[bytes, str]:
    """The policy file of another file, or of currents [A]; and its origin in words."""
    with needs("an export", "bench"):
        from emb_bench.export.own_policy import onnx_policy
        from emb_bench.export.policy_file import sequence_file
        from emb_bench.export.sequence import limited, read_sequence
    if isinstance(policy, str | Path) and Path(policy).suffix.lower() == ".onnx":
        return onnx_policy(Path(policy), bench, kind)
    if kind != "current":
        raise UsageError(f"kind: {kind} is for a network; a file of currents, an excitation or an array has currents")
    if is_row(policy):
        currents, what = limited(planned(policy).currents, bench, "the currents")
    elif isinstance(policy, str | Path):
        currents, what = read_sequence(str(policy), bench)
    else:
        kinds = "a file, a module or function of torch, a model of Stable-Baselines3, or currents"
        raise UsageError(f"expected {kinds}, got {type(policy).__name__}")
    return sequence_file(currents, what, bench), what
