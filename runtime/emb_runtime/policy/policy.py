"""A trained actor as the runtime drives it: one ONNX file, checked against its contract and the bench.

What is loaded is not trusted: the file is bounded in size, must stand alone (no side-car, no control flow), must be
made of operators whose work is the same for every sample (:mod:`emb_runtime.policy.operators`), must have exactly the
inputs and outputs of the contract, must fit the bench, and must reproduce its test vectors before :func:`load_policy`
returns it. What it says afterwards is still clipped, shielded and guarded.

ONNX Runtime judges every file (:mod:`emb_runtime.policy.inference`). A plain network is then evaluated by
:mod:`emb_runtime.policy.mlp`, and a graph of many small nodes by :mod:`emb_runtime.policy.scalar_graph`, if that says
the same for every test vector and for many more observations: each is several times as fast. Their results differ by
rounding, so the log names the one that was used, and a rerun uses it again.
"""

from __future__ import annotations

import hashlib
import random
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

from emb_runtime.config.bench import CEILING_CURRENT, Bench
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.policy.contract import CONTRACT_KEY, OBSERVATION, VECTOR_TOLERANCE, Contract
from emb_runtime.policy.inference import INPUT_NAME, OUTPUT_NAME, Inference
from emb_runtime.policy.mlp import network
from emb_runtime.policy.onnx_file import Graph, read_graph
from emb_runtime.policy.operators import require_bounded
from emb_runtime.policy.scalar_graph import scalar_actor
from emb_runtime.policy.shapes import require_bounded_work
from emb_runtime.system.input_file import open_regular

Row = tuple[float, ...]

MAX_FILE_BYTES = 4 * 1024 * 1024  # An actor is tens or hundreds of kilobytes; what is far beyond is no actor

PROBES = 200  # Observations, besides the test vectors, at which a faster evaluation must say the same

ASIDE = 0.01
"""Distance of such observations from the test vectors where there is a state, as a part of the bench's limits: with a
state observations must make sense together."""

ONNX_RUNTIME, NUMPY, SCALARS = "onnxruntime", "numpy", "scalar operations"  # Evaluations of a policy, by name

WARM_UP_RUNS = 20
"""ONNX Runtime allocates and selects kernels in its first runs; they must not fall into the experiment."""


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
        evaluated_by: ``onnxruntime``, ``numpy``, or ``scalar operations``.
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


def load_policy(source: str | Path | bytes, bench: Bench, evaluated_by: str = "") -> Policy:
    """Read, check and warm up an actor, in this process: one of our own, or one that was tried.

    What comes from outside goes through :func:`emb_runtime.policy.trial.admit_policy`.

    Args:
        source: path of the ONNX file, or its bytes.
        bench: what it is to drive.
        evaluated_by: what evaluated it before, so that it says the same bit for bit; empty for the fastest there is.

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
    require_bounded_work(graph)
    policy = Policy(contract, data, Inference(data, contract), ONNX_RUNTIME)
    _replay_vectors(policy)
    name, fast = _faster(graph, contract)
    if fast is not None and evaluated_by in ("", name):
        faster = Policy(contract, data, fast, name)
        if _agree(faster, policy, bench):
            policy = faster
    for _ in range(WARM_UP_RUNS):
        policy.begin()
        policy.act(0.0, 0.0, 0, 0.0)
    policy.begin()
    return policy


def _faster(graph: Graph, contract: Contract) -> tuple[str, Evaluation | None]:
    """An evaluation that is faster than ONNX Runtime's, if there is one, and its name."""
    is_plain = contract.observation == OBSERVATION and not contract.initial_state and not contract.estimates
    plain = network(graph, INPUT_NAME, OUTPUT_NAME) if is_plain else None
    return (NUMPY, plain) if plain is not None else (SCALARS, scalar_actor(graph, contract))


def _agree(one: Policy, other: Policy, bench: Bench) -> bool:
    """Returns True if two evaluations of a policy agree, at its test vectors and besides."""
    probes = _probes(other.contract, bench)
    try:
        _replay_vectors(one)
        rows = [
            ([number for part in ours for number in part], [number for part in theirs for number in part])
            for ours, theirs in zip(_played(one, probes), _played(other, probes), strict=True)
        ]
    except PolicyRefusedError:
        return False
    allowed = (_tolerance(other.contract), *_largest([theirs[1:] for _, theirs in rows]))
    # NaN compares false, so it is refused.
    return all(abs(a - b) <= most for row in rows for a, b, most in zip(*row, allowed, strict=True))


def _probes(contract: Contract, bench: Bench) -> list[list[list[float]]]:
    """Sequences of observations: all over the bench, or beside those of the test vectors."""
    dice = random.Random(0)
    (low, high), speed, current = bench.limits.angle, bench.limits.velocity, bench.limits.current
    ends = (low, high), (-speed, speed), (0.0, bench.timing.horizon), (-current, current)
    width = len(contract.observation)
    if not contract.initial_state:
        return [[[dice.uniform(*pair) for pair in ends[:width]]] for _ in range(PROBES)]
    each = max(1, PROBES // len(contract.sequences))
    moved = ASIDE, ASIDE, 0.0, ASIDE
    return [
        [
            [x + part * dice.uniform(*pair) for x, part, pair in zip(vector.observation, moved, ends, strict=False)]
            for vector in sequence[:each]
        ]
        for sequence in contract.sequences
    ]


def _tolerance(contract: Contract) -> float:
    """Largest difference of an action from the contract's [A]; a contract cannot widen it beyond all currents."""
    return VECTOR_TOLERANCE * min(contract.action_limit, CEILING_CURRENT)


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


def _replay_vectors(policy: Policy) -> None:
    vectors = policy.contract.vectors
    allowed = {
        "current [A]": (_tolerance(policy.contract),),
        "state": _largest([v.state for v in vectors]),
        "estimate": _largest([v.estimate for v in vectors]),
    }
    observations = [[vector.observation for vector in sequence] for sequence in policy.contract.sequences]
    for index, (vector, said) in enumerate(zip(vectors, _played(policy, observations), strict=True)):
        wanted = (vector.action,), vector.state, vector.estimate
        for (part, most), told, got in zip(allowed.items(), wanted, said, strict=True):
            if told:  # a contract need not tell what is remembered and estimated at every sample
                _require_near(f"test vector {index}: the policy's {part}", told, got, most)


def _played(policy: Policy, sequences: Sequence[Sequence[Sequence[float]]]) -> Iterator[tuple[Row, Row, Row]]:
    """Action, state and estimate at each sample of sequences."""
    for sequence in sequences:
        policy.begin()
        for angle, velocity, step, *current in sequence:
            action = policy.act(angle, velocity, step, *(current or (0.0,)))
            yield (action,), policy.state, policy.estimate


def _largest(rows: Sequence[Sequence[float]]) -> tuple[float, ...]:
    """Largest error of each number of a state or an estimate: a part of its largest recorded value."""
    columns = zip(*(row for row in rows if row), strict=True)
    return tuple(VECTOR_TOLERANCE * (max(map(abs, column)) or 1.0) for column in columns)


def _require_near(what: str, told: Sequence[float], said: Sequence[float], allowed: Sequence[float]) -> None:
    for number, (wanted, got, tolerance) in enumerate(zip(told, said, allowed, strict=True)):
        if not abs(got - wanted) <= tolerance:  # written so that NaN is refused
            place = f", number {number}," if len(told) > 1 else ""
            raise PolicyRefusedError(
                f"{what}{place} should be {wanted:.7g} and is {got:.7g}: the file is damaged or this ONNX Runtime "
                "computes something else; export it again"
            )


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
