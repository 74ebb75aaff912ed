"""Experience: experiments side by side that follow the actor, with exploration."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from emb_bench.compiled import compiled
from emb_bench.information.symmetric import Floats
from emb_train.envs.conditions import MEASURED
from emb_train.envs.env import EmbExcitationVectorEnv
from emb_train.ppo.networks import Actor
from emb_train.ppo.rollout_kernel import Singles, follow
from emb_train.rewards import Mark, Returning, Transition


@dataclass(frozen=True)
class Rollout:
    """N T steps. Time is the first axis, experiments the second."""

    actor_seen: Tensor  # Shape [T, N, I]
    critic_seen: Tensor  # Shape [T, N, C]
    actions: Tensor
    """Actions as sampled, before they are clipped, shape [T, N, 1]. One that answered a lost sample had no effect and
    is kept: what follows does not depend on it, so that it adds noise to the gradient and no bias.
    """
    rewards: Tensor  # Shape [T, N]
    terminals: Tensor  # 1 where the step ended its experiment, shape [T, N]
    last_critic_seen: Tensor
    """Critic observations after the last step, shape [N, C]; used where that did not end the experiment."""
    final_fim: float  # Mean of the first diagonal element of the FIM over the experiments that ended; NaN if none did
    ended: int  # Experiments that ended
    violations: int  # Experiments among these that left the limits
    home: int  # Experiments among these that ended at home


def exploration_noise(steps: int, envs: int, noise_memory: float, generator: torch.Generator) -> Tensor:
    """Gaussian noise with standard deviation 1 at every step and correlation ``noise_memory`` from step to step.

    White noise at 1 kHz averages out before the brake notices. Each step's own density is unchanged, and the policy's
    gradient estimated with it is the true one of the smoothed objective times the noise's covariance over time: an
    ascent direction that moves neighbouring steps together.

    Returns:
        Shape [steps, envs, 1].
    """
    noise = torch.randn(steps, envs, 1, generator=generator)
    if noise_memory > 0.0:
        noise[1:] *= math.sqrt(1.0 - noise_memory * noise_memory)
        rows = noise.unbind()
        for before, after in itertools.pairwise(rows):
            after.add_(before, alpha=noise_memory)
    return noise


def usable(threads: int) -> int:
    """Returns the number of threads, at most as many as this process may use."""
    there: Any = numba.config
    return min(threads, int(there.NUMBA_NUM_THREADS))


def collect(
    env: EmbExcitationVectorEnv,
    actor: Actor,
    steps: int,
    noise_memory: float,
    seeds: list[int],
    generator: torch.Generator,
    threads: int = 1,
    exploration: float = 1.0,
) -> Rollout:
    """Begin new experiments with these seeds and follow the actor, with exploration, for ``steps`` steps.

    It is what ``env.step`` would give with these actions, bit for bit, for any number of threads, at a fraction of the
    time. An experiment that ends begins again with another brake, except after the last step.

    Args:
        env: with N experiments.
        actor: on the CPU.
        steps: T.
        noise_memory: see :func:`exploration_noise`.
        seeds: of the N experiments.
        generator: of the exploration.
        threads: that experiments are shared out to, no more than there are processors.
        exploration: times the policy's own standard deviation; 0 for the mean action.
    """
    env.reset(seed=seeds)
    batch, n = env.batch, env.num_envs
    noise = exploration_noise(steps, n, noise_memory, generator)
    with torch.no_grad():
        actions = (noise * (exploration * actor.log_deviation.exp())).numpy()
    weights, biases = packed(actor.layers)
    actor_seen = np.empty((steps, n, batch.observation_size), np.float32)
    critic_seen = np.empty((steps, n, batch.critic_size), np.float32)
    terminals = np.zeros((steps, n), np.float32)
    ms, xs = np.empty((steps, *batch.m.shape)), np.empty((steps, n, 2))
    ks, left = np.empty((steps, n), np.int64), np.empty((steps, n), np.bool_)
    made = np.zeros(n, np.int64)
    final_fim, ended, violations, home = 0.0, 0, 0, 0
    run: Any = compiled(follow, parallel=True)
    torch_threads = torch.get_num_threads()
    numba.set_num_threads(usable(threads))
    while True:
        before = made.copy()
        run(
            *batch.setup,
            batch.scale,
            batch.experiments,
            batch.bench.limits.current,
            batch.conditions.observes == MEASURED,
            actor.centre.numpy(),
            actor.span.numpy(),
            weights,
            biases,
            made,
            actor_seen,
            critic_seen,
            actions,
            ms,
            xs,
            ks,
            left,
        )
        torch.set_num_threads(torch_threads)  # both may use OpenMP, and numba leaves its own number there
        over = batch.terminated & (made > before)  # of those that ended in this pass: each counts once
        terminals[made[over] - 1, over] = 1.0
        ended += int(over.sum())
        final_fim += float(batch.m[over, 0].sum())
        violations += int(batch.violated[over].sum())
        home += int(batch.home[over].sum())
        if not (again := over & (made < steps)).any():
            break
        env.begin_again(again)
    return Rollout(
        torch.from_numpy(actor_seen),
        torch.from_numpy(critic_seen),
        torch.from_numpy(actions),
        torch.from_numpy(scored(env, ms, xs, ks, left).astype(np.float32)),
        torch.from_numpy(terminals),
        torch.from_numpy(batch.critic_observation()),
        final_fim / ended if ended else math.nan,
        ended,
        violations,
        home,
    )


def scored(env: EmbExcitationVectorEnv, m: Floats, x: Floats, k: NDArray[np.int64], left: NDArray[np.bool_]) -> Floats:
    """Rewards of all steps at once: the numbers that :class:`emb_train.envs.env.Scoring` gives step for step.

    Args:
        env: whose reward it is.
        m: packed FIM after each step, shape [T, N, n (n + 1) / 2].
        x: true angle [rad] and velocity [rad/s] after each step, shape [T, N, 2].
        k: steps that the experiment has made then, shape [T, N].
        left: whether it has left the limits, shape [T, N].

    Returns:
        Shape [T, N].
    """
    reward, rules = env.reward, env.batch.setup.rules
    first = (k == 1)[..., None]
    before = np.where(first, 0.0, np.concatenate((np.zeros_like(m[:1]), m[:-1])))
    mark = Mark(np.zeros_like(x), np.zeros_like(x[..., 0]), np.zeros_like(m))
    if isinstance(reward, Returning):
        velocity = np.where(first[..., 0], 0.0, np.concatenate((np.zeros_like(x[:1, :, 1]), x[:-1, :, 1])))
        acceleration = (x[..., 1] - velocity) / rules.sample_time
        t, i = np.nonzero(k >= reward.outward)
        turned = t - (k[t, i] - reward.outward)
        mark.x[t, i], mark.acceleration[t, i], mark.m[t, i] = x[turned, i], acceleration[turned, i], m[turned, i]
    flat = Mark(mark.x.reshape(-1, 2), mark.acceleration.ravel(), mark.m.reshape(-1, m.shape[-1]))
    transition = Transition(
        before.reshape(-1, m.shape[-1]),
        m.reshape(-1, m.shape[-1]),
        x.reshape(-1, 2),
        k.ravel(),
        left.ravel(),
        flat,
        rules.horizon,
        rules.sample_time,
    )
    return reward(transition).reshape(k.shape)


def packed(layers: nn.Sequential) -> tuple[tuple[Singles, ...], tuple[Singles, ...]]:
    """Weights and biases as :func:`emb_train.ppo.rollout_kernel.perceive` takes them."""
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    weights = [layer.weight.detach().numpy().T for layer in linear]
    padded = tuple(np.ascontiguousarray(np.pad(w, ((0, -len(w) % 4), (0, 0)))) for w in weights)
    return padded, tuple(layer.bias.detach().numpy() for layer in linear)
