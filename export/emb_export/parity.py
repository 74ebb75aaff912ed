"""The proof that the exported file computes what the trained network computes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from emb_bench.compiled import compiled
from emb_runtime.config.bench import Bench, Ranges
from emb_runtime.errors import PolicyRefusedError
from emb_runtime.policy.contract import VECTOR_TOLERANCE
from emb_runtime.policy.policy import Policy
from emb_train.envs.batch import Batch
from emb_train.envs.excitations import PLAIN, Excitation, Network
from emb_train.envs.play import followed
from emb_train.ppo.networks import DeployedActor

EPISODES = 8
RANDOM_OBSERVATIONS = 2000

Floats = NDArray[np.float32]


def recorded(excitation: Excitation, bench: Bench, ranges: Ranges, parameters: Sequence[str]) -> Floats:
    """What an excitation sees in a few experiments on random brakes, shape [horizon, EPISODES, 4]."""
    batch = Batch(bench, ranges, parameters, EPISODES, compiled)
    for i in range(EPISODES):
        batch.begin(i, np.random.default_rng(i))
    return np.stack(list(followed(batch, excitation)))


def recorded_observations(actor: DeployedActor, bench: Bench, ranges: Ranges, parameters: tuple[str, ...]) -> Floats:
    """What the actor sees in a few experiments on random brakes, shape [EPISODES · horizon, 3]."""
    return recorded(Network(actor), bench, ranges, parameters)[:, :, :PLAIN].reshape(-1, PLAIN)


def random_observations(bench: Bench) -> Floats:
    """Observations all over the limits and well beyond them, shape [RANDOM_OBSERVATIONS, 3]."""
    rng = np.random.default_rng(0)
    low, high = bench.limits.angle
    width = high - low
    size = RANDOM_OBSERVATIONS
    return np.stack(
        [
            rng.uniform(low - width, high + width, size),
            rng.uniform(-3.0, 3.0, size) * bench.limits.velocity,
            rng.uniform(0.0, bench.timing.horizon, size),
        ],
        axis=1,
    ).astype(np.float32)


def require_parity(actor: DeployedActor, policy: Policy, observations: Floats) -> float:
    """Compare the network with the file, through the runtime's own policy.

    Args:
        actor: the trained network.
        policy: the exported file, loaded.
        observations: shape [M, 3].

    Returns:
        The largest difference as a part of the current limit.

    Raises:
        PolicyRefusedError: it is above 1e-5, or an answer is not finite.
    """
    with torch.no_grad():
        wanted = actor(torch.from_numpy(observations))[:, 0].numpy().astype(np.float64)
    got = np.array([policy.act(float(a), float(v), float(k), 0.0) for a, v, k in observations])
    worst = float(np.max(np.abs(got - wanted))) / actor.limit
    if not worst <= VECTOR_TOLERANCE:  # written so that NaN fails
        raise PolicyRefusedError(
            f"the exported graph differs from the trained network by {worst:.3g} of the limit, at most "
            f"{VECTOR_TOLERANCE:g} is allowed: nothing was written"
        )
    return worst
