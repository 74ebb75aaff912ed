"""A trained actor as the runtime drives it: one ONNX file, checked against its contract and the bench.

What is loaded is not trusted: the file is bounded in size, must stand alone (no side-car, no control flow), must be
made of operators whose work is the same for every sample (:mod:`emb_runtime.policy.operators`), must have exactly the
inputs and outputs of the contract, must fit the bench, and must reproduce its test vectors before :func:`load_policy`
returns it. Its actions are still clipped, shielded and guarded.

A graph of many small nodes is evaluated by :mod:`emb_runtime.policy.scalar_graph` if that gives what ONNX Runtime
gives, which takes several times as long; every other one by ONNX Runtime (:mod:`emb_runtime.policy.inference`). Their
results differ by rounding, so the log names the one that was used, and a rerun uses it again.
"""

from __future__ import annotations

import hashlib
import random
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Protocol

from emb_runtime.config.bench import CEILING_CURRENT, Bench
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.policy.contract import CONTRACT_KEY, VECTOR_TOLERANCE, Contract, Vector
from emb_runtime.policy.inference import Inference
from emb_runtime.policy.onnx_file import Graph, read_graph
from emb_runtime.policy.operators import require_bounded
from emb_runtime.policy.scalar_graph import scalar_actor
from emb_runtime.system.input_file import open_regular

MAX_FILE_BYTES = 4 * 1024 * 1024  # An actor is tens or hundreds of kilobytes

PROBES = 200  # Observations beside the test vectors at which scalar operations must give what ONNX Runtime gives
ASIDE = 0.01  # Largest distance of such an observation from a test vector, as a part of the bench's limits

ONNX_RUNTIME, SCALARS = "onnxruntime", "scalar operations"  # Evaluations of a policy, by name


def shipped_actor_path(quick: bool = False) -> Path:
    """Path of the actor that is shipped with the package: the one for a whole experiment, or for a short one."""
    return Path(__file__).with_name("quick.onnx" if quick else "actor.onnx")


class Evaluation(Protocol):
    """Something that evaluates a graph, sample by sample; see :class:`Policy`."""

    @property
    def estimate(self) -> tuple[float, ...]:
        """Latest estimate."""
        ...

    @property
    def state(self) -> tuple[float, ...]:
        """State between samples."""
        ...

    def begin(self) -> None:
        """Begin anew."""

    def act(self, angle: float, velocity: float, step: float, applied_current: float) -> float:
        """Action for one sample."""
        ...


class Policy:
    """An actor that passed all checks; made by :func:`load_policy` only.

    What it remembers of the samples so far is kept here: :meth:`begin` comes before the first sample of a run.

    Attributes:
        contract: what it was trained for.
        data: the ONNX file as it was read, for the log.
        sha256: of :attr:`data`, in hexadecimal.
        evaluated_by: ``onnxruntime`` or ``scalar operations``.
    """

    def __init__(self, contract: Contract, data: bytes, evaluation: Evaluation, evaluated_by: str) -> None:
        self.contract = contract
        self.data = data
        self.sha256 = hashlib.sha256(data).hexdigest()
        self.evaluated_by = evaluated_by
        self._evaluation = evaluation
        self._act = evaluation.act

    @property
    def estimate(self) -> tuple[float, ...]:
        """Values of the contract's estimates, then their standard deviations; empty if it has none."""
        return self._evaluation.estimate

    @property
    def state(self) -> tuple[float, ...]:
        """State after the samples so far; empty if it has none."""
        return self._evaluation.state

    def begin(self) -> None:
        """Forget what was seen: the next sample is the first one of a run."""
        self._evaluation.begin()

    def act(self, angle: float, velocity: float, step: float, applied_current: float) -> float:
        """Returns the action for the period that begins at this sample.

        Args:
            angle: measured [rad].
            velocity: measured [rad/s].
            step: samples since the experiment began.
            applied_current: what acted in the period that ends at this sample [A].

        Returns:
            The current [A] as the graph gives it: whether it is finite and within limits is for the caller to check.

        Raises:
            PolicyRefusedError: ONNX Runtime could not evaluate the graph, or what it remembers or estimates is not
                finite.
        """
        return self._act(angle, velocity, step, applied_current)


def load_policy(source: str | Path | bytes, bench: Bench, evaluated_by: str = "", compared: bool = False) -> Policy:
    """Read and check an actor, in this process: one of our own, or one that was tried.

    What comes from outside goes through :func:`emb_runtime.policy.trial.admit_policy`.

    Args:
        source: path of the ONNX file, or its bytes.
        bench: what it is to drive.
        evaluated_by: evaluation that it must have; empty for the fastest there is.
        compared: it was loaded without this before, by the same version: its scalar operations are held against one
            sequence of test vectors only, and ONNX Runtime is not loaded for them.

    Raises:
        UsageError: the file cannot be read.
        PolicyRefusedError: it is damaged, not self-contained, has work that depends on what is measured, has another
            signature than the contract's, does not fit the bench, or does not reproduce its test vectors.
    """
    data = source if isinstance(source, bytes) else read_policy(Path(source))
    if len(data) > MAX_FILE_BYTES:
        raise PolicyRefusedError(f"the policy file is larger than {MAX_FILE_BYTES} bytes: not an actor of ours")
    graph = read_graph(data)
    contract = Contract.from_json(_contract_text(graph))
    contract.require_bench(bench)
    require_bounded(graph)
    scalars = scalar_actor(graph, contract) if evaluated_by in ("", SCALARS) else None
    reference = None if compared and scalars is not None else Inference(data, contract)
    if scalars is not None and _is_right(scalars, reference, contract, bench):
        return Policy(contract, data, scalars, SCALARS)
    reference = reference or Inference(data, contract)
    if error := compare(contract.vectors, played(reference, contract.sequences), contract):
        raise PolicyRefusedError(
            f"test vector {error}: the file is damaged or this ONNX Runtime computes something else; export it again"
        )
    reference.begin()
    return Policy(contract, data, reference, ONNX_RUNTIME)


def _is_right(scalars: Evaluation, reference: Evaluation | None, contract: Contract, bench: Bench) -> bool:
    """Returns True if scalar operations reproduce the test vectors, and give what ONNX Runtime gives beside them.

    Without a reference one sequence of test vectors is enough.
    """
    try:
        sequences = contract.sequences if reference is not None else contract.sequences[:1]
        if compare([*chain.from_iterable(sequences)], played(scalars, sequences), contract):
            return False
        if reference is not None:
            probes = _probes(contract, bench)
            if compare(played(reference, probes), played(scalars, probes), contract):
                return False
    except PolicyRefusedError:
        return False
    scalars.begin()
    return True


def _probes(contract: Contract, bench: Bench) -> list[list[Vector]]:
    """Sequences of observations beside those of the test vectors: with a state they must make sense together."""
    dice = random.Random(0)
    each = max(1, PROBES // len(contract.sequences))
    moved = ASIDE * max(map(abs, bench.limits.angle)), ASIDE * bench.limits.velocity, 0.0, ASIDE * bench.limits.current
    return [
        [
            Vector(tuple(x + dice.uniform(-d, d) for x, d in zip(vector.observation, moved, strict=False)), 0.0)
            for vector in sequence[:each]
        ]
        for sequence in contract.sequences
    ]


def played(evaluation: Evaluation, sequences: Sequence[Sequence[Vector]]) -> list[Vector]:
    """Outputs of an evaluation for the observations of sequences, each from the initial state."""
    given = []
    for sequence in sequences:
        evaluation.begin()
        for observation, *_ in sequence:
            angle, velocity, step, *current = observation
            action = evaluation.act(angle, velocity, step, *(current or (0.0,)))
            given.append(Vector(observation, action, evaluation.state, evaluation.estimate))
    return given


def compare(wanted: Sequence[Vector], got: Sequence[Vector], contract: Contract) -> str:
    """First number of two evaluations that differs by more than :data:`VECTOR_TOLERANCE`; empty if none does.

    The tolerance of an action is a part of its limit, which a contract cannot widen beyond all currents; that of a
    number of a state or an estimate is a part of its largest wanted value. A vector need not have both.
    """
    limits = {
        "current [A]": [min(contract.action_limit, CEILING_CURRENT)],
        "state": _largest([vector.state for vector in wanted]),
        "estimate": _largest([vector.estimate for vector in wanted]),
    }
    for index, vectors in enumerate(zip(wanted, got, strict=True)):
        parts = (((vector.action,), vector.state, vector.estimate) for vector in vectors)
        for (part, limit), wants, gets in zip(limits.items(), *parts, strict=True):
            for number, (a, b, most) in enumerate(zip(wants, gets, limit, strict=True) if wants else ()):
                if not abs(a - b) <= VECTOR_TOLERANCE * most:  # so written, NaN differs
                    place = f", number {number}," if len(wants) > 1 else ""
                    return f"{index}: the policy's {part}{place} should be {a:.7g} and is {b:.7g}"
    return ""


def _largest(rows: Sequence[Sequence[float]]) -> list[float]:
    """Largest magnitude in each column of the rows that have any; 1 where all are zero."""
    return [max(map(abs, column)) or 1.0 for column in zip(*filter(None, rows), strict=True)]


def read_policy(path: Path) -> bytes:
    """Bytes of a policy file, one more than are allowed at most.

    Raises:
        UsageError: it cannot be read.
    """
    try:
        with open_regular(path) as file:
            return file.read(MAX_FILE_BYTES + 1)
    except OSError as err:
        raise UsageError(f"{path}: cannot read the policy file: {err.strerror}") from err


def _contract_text(graph: Graph) -> str:
    """The contract in a file's metadata.

    Raises:
        PolicyRefusedError: there is none, or more than one.
    """
    texts = [value for key, value in graph.texts if key == CONTRACT_KEY]
    if len(texts) != 1:
        raise PolicyRefusedError(
            f"expected one '{CONTRACT_KEY}' in the ONNX metadata, got {len(texts)}: not exported by emb-export"
        )
    return texts[0]
