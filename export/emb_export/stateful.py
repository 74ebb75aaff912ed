"""An actor with a state, such as a structured one with its estimate, as an ONNX graph with its contract.

The proof is of whole experiments: current, state and estimate of the exported file at each sample, from the
initial state on, through the runtime's own policy, against the module in torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from emb_bench.brake.parameters import SI
from emb_export.file import add_contract, contract_for
from emb_export.network import graph_of, recorded
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, Ranges
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.estimator.estimate import Quantity
from emb_runtime.policy.contract import APPLIED_CURRENT, OBSERVATION, VECTOR_TOLERANCE, Vector
from emb_runtime.policy.inference import ESTIMATE_NAME, INPUT_NAME, NEXT_STATE_NAME, OUTPUT_NAME, STATE_NAME
from emb_runtime.policy.policy import Policy, load_policy
from emb_train.envs.network import StatefulNetwork

SEQUENCES = 2  # Experiments whose samples become test vectors
LONGEST = 512  # Samples of each
TELLING = 64
"""Interval [samples] at which the test vector contains state and estimate as well; the last sample has them too."""

Floats = NDArray[np.float64]


class StatefulActor(Protocol):
    """A torch module with its state as input and output."""

    @property
    def initial_state(self) -> Tensor:
        """Before the first sample, shape [S]."""
        ...

    @property
    def estimates(self) -> tuple[str, ...]:
        """Names of the n quantities that it estimates; parameters of the brake."""
        ...

    @property
    def observation_size(self) -> int:
        """3: angle [rad], velocity [rad/s] and step; 4: the current that acted last [A] as well."""
        ...

    def __call__(self, obs: Tensor, state: Tensor, /) -> tuple[Tensor, Tensor, Tensor]:
        """Currents [A], float32 [N, 1], next state [N, S], estimate, float32 [N, 2 n]; state in float64."""
        ...


class Answers(NamedTuple):
    """Answers of an actor in E experiments of T samples."""

    currents: Floats  # [A], shape [E, T]
    states: Floats  # After each sample, shape [E, T, S]
    estimates: Floats  # Values, then standard deviations, shape [E, T, 2 n]


def export_stateful(
    actor: StatefulActor, bench: Bench, ranges: Ranges, provenance: Mapping[str, str | int | float]
) -> tuple[bytes, float]:
    """The file's bytes and how far it is from the module, as a part of the current limit.

    Raises:
        UsageError: it estimates something that is no parameter of a brake.
        PolicyRefusedError: the file would be refused by the runtime, or differs from the module.
    """
    unknown = [name for name in actor.estimates if name not in SI]
    if unknown:
        raise UsageError(f"the actor estimates {', '.join(unknown)}: expected parameters, {', '.join(SI)}")
    seen = recorded_sequences(actor, bench, ranges)
    wanted = answers(actor, seen)
    if not all(np.isfinite(part).all() for part in wanted):
        raise PolicyRefusedError("the actor's answers are not finite: there is nothing to export")
    contract = contract_for(
        bench,
        ranges.low,
        ranges.high,
        tuple(_sequence(seen[i], Answers(*(part[i] for part in wanted))) for i in range(SEQUENCES)),
        provenance,
        observation=(*OBSERVATION, APPLIED_CURRENT)[: actor.observation_size],
        initial_state=tuple(actor.initial_state.tolist()),
        estimates=tuple(Quantity(name, SI[name]) for name in actor.estimates),
    )
    data = add_contract(_graph(actor), contract)
    return data, require_sequence_parity(wanted, load_policy(data, bench), seen)


def recorded_sequences(actor: StatefulActor, bench: Bench, ranges: Ranges) -> NDArray[np.float32]:
    """Observations of an actor in a few experiments on random brakes, shape [EPISODES, horizon, 3 or 4]."""
    seen = recorded(StatefulNetwork(actor), bench, ranges, PARAMETER_NAMES)
    return seen.swapaxes(0, 1)[:, :, : actor.observation_size]


def answers(actor: StatefulActor, seen: NDArray[np.float32]) -> Answers:
    """Answers of the module to observations, shape [E, T, 3 or 4], each experiment from the initial state."""
    state = actor.initial_state.double().repeat(len(seen), 1)
    said: list[tuple[Tensor, Tensor, Tensor]] = []
    with torch.no_grad():
        for k in range(seen.shape[1]):
            current, state, estimate = actor(torch.from_numpy(np.ascontiguousarray(seen[:, k])), state)
            said.append((current[:, 0].double(), state, estimate.double()))
    currents, states, estimates = (torch.stack(part, dim=1).numpy() for part in zip(*said, strict=True))
    return Answers(currents, states, estimates)


def require_sequence_parity(wanted: Answers, policy: Policy, seen: NDArray[np.float32]) -> float:
    """Compare the module with the file, through the runtime's own policy.

    Args:
        wanted: the module's answers.
        policy: the exported file, loaded.
        seen: the observations of both, shape [E, T, 3 or 4].

    Returns:
        The largest difference of a current as a part of the current limit.

    Raises:
        PolicyRefusedError: it is above 1e-5; or a number of the state or of the estimate is further off than that, as
            a part of the largest value that it takes.
    """
    said = _said(policy, seen)
    worst = float(np.max(np.abs(said.currents - wanted.currents))) / policy.contract.action_limit
    differences = {"current": worst} | {
        name: _difference(got, there)
        for name, got, there in (
            ("state", said.states, wanted.states),
            ("estimate", said.estimates, wanted.estimates),
        )
    }
    for name, difference in differences.items():
        if not difference <= VECTOR_TOLERANCE:  # written so that NaN fails
            raise PolicyRefusedError(
                f"the exported graph differs from the actor: its {name} by {difference:.3g} of the largest, at most "
                f"{VECTOR_TOLERANCE:g} is allowed: nothing was written"
            )
    return worst


def _said(policy: Policy, seen: NDArray[np.float32]) -> Answers:
    currents, states, estimates = [], [], []
    for experiment in seen.tolist():
        policy.begin()
        for angle, velocity, step, *current in experiment:
            currents.append(policy.act(angle, velocity, step, *(current or (0.0,))))
            states.append(policy.state)
            estimates.append(policy.estimate)
    rows = seen.shape[:2]
    return Answers(
        np.array(currents).reshape(rows), np.array(states).reshape(*rows, -1), np.array(estimates).reshape(*rows, -1)
    )


def _difference(got: Floats, wanted: Floats) -> float:
    """The largest one, each number as a part of the largest value that it takes."""
    if not wanted.size:
        return 0.0
    scale = np.max(np.abs(wanted), axis=(0, 1))
    return float(np.max(np.abs(got - wanted) / np.where(scale > 0.0, scale, 1.0)))


def _sequence(seen: NDArray[np.float32], said: Answers) -> tuple[Vector, ...]:
    """Test vectors of one experiment; arrays as in :class:`Answers`, without the first dimension."""
    count = min(LONGEST, len(seen))
    vectors = []
    for k in range(count):
        with_state = (k + 1) % TELLING == 0 or k == count - 1
        rest = (tuple(said.states[k].tolist()), tuple(said.estimates[k].tolist())) if with_state else ()
        vectors.append(Vector(tuple(seen[k].tolist()), float(said.currents[k]), *rest))
    return tuple(vectors)


class _WithoutEstimate(nn.Module):
    """A graph has no output for what is not estimated."""

    def __init__(self, actor: Any) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, obs: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        current, following, _ = self.actor(obs, state)
        return current, following


def _graph(actor: StatefulActor) -> Any:
    module: Any = actor if actor.estimates else _WithoutEstimate(actor)
    examples = torch.zeros(1, actor.observation_size), actor.initial_state.double()[None]
    outputs = [OUTPUT_NAME, NEXT_STATE_NAME, *([ESTIMATE_NAME] if actor.estimates else [])]
    return graph_of(module, examples, [INPUT_NAME, STATE_NAME], outputs)
