"""Experience of an actor with a memory: the environment's own steps, one after the other."""

from __future__ import annotations

import math

import numpy as np
import torch

from emb_train.envs.excitations import Excitation, Network, StatefulNetwork
from emb_train.envs.vector_env import EmbExcitationVectorEnv
from emb_train.ppo.networks import Actor, DeployedActor, DeployedRecurrentActor, RecurrentActor
from emb_train.ppo.rollout import Rollout, collect, exploration_noise


def experience(
    env: EmbExcitationVectorEnv,
    actor: Actor | RecurrentActor,
    steps: int,
    noise_memory: float,
    seeds: list[int],
    generator: torch.Generator,
    threads: int = 1,
    exploration: float = 1.0,
) -> Rollout:
    """What :func:`emb_train.ppo.rollout.collect` gives, whose arguments these are, for either kind of actor."""
    if isinstance(actor, RecurrentActor):
        return remembered(env, actor, steps, noise_memory, seeds, generator, exploration)
    return collect(env, actor, steps, noise_memory, seeds, generator, threads, exploration)


def excitation_of(actor: Actor | RecurrentActor, limit: float) -> Excitation:
    """What a trained actor asks for on a bench with this current limit [A], without exploration."""
    if isinstance(actor, RecurrentActor):
        return StatefulNetwork(DeployedRecurrentActor(actor, limit))
    return Network(DeployedActor(actor, limit))


@torch.no_grad()
def remembered(
    env: EmbExcitationVectorEnv,
    actor: RecurrentActor,
    steps: int,
    noise_memory: float,
    seeds: list[int],
    generator: torch.Generator,
    exploration: float = 1.0,
) -> Rollout:
    """Follow an actor with a memory, which is empty at the start of each experiment.

    Arguments as for :func:`emb_train.ppo.rollout.collect`; it is slower, for every step returns to Python. Where a
    sample was lost, the actor is not asked: what it saw is NaN but for the step, and it remembers what it did before.
    """
    _, info = env.reset(seed=seeds)
    batch, n = env.batch, env.num_envs
    actor_seen = np.empty((steps, n, len(actor.span)), np.float32)
    critic_seen = np.empty((steps, n, batch.critic_size), np.float32)
    rewards, ended = np.empty((steps, n), np.float32), np.empty((steps, n), np.bool_)
    actions = exploration_noise(steps, n, noise_memory, generator) * (exploration * actor.log_deviation.exp())
    remembers = torch.zeros(n, actor.memory)
    final_fim, violations, home = 0.0, 0, 0
    for t in range(steps):
        actor_seen[t], critic_seen[t] = batch.seen(), info["critic"]
        seen = torch.from_numpy(actor_seen[t])
        mean, then = actor(seen.nan_to_num(), remembers)
        remembers = torch.where(seen[:, :1].isnan(), remembers, then)
        actions[t] += mean
        _, rewards[t], over, _, info = env.step(actor.part(actions[t]).numpy())
        ended[t] = over
        if over.any():
            remembers[torch.from_numpy(over)] = 0.0
            last = info["final_info"]
            final_fim += float(last["fim"][over, 0].sum())
            violations += int(last["violated"][over].sum())
            home += int(last["home"][over].sum())
    count = int(ended.sum())
    return Rollout(
        torch.from_numpy(actor_seen),
        torch.from_numpy(critic_seen),
        actions,
        torch.from_numpy(rewards),
        torch.from_numpy(ended.astype(np.float32)),
        torch.from_numpy(info["critic"]),
        final_fim / count if count else math.nan,
        count,
        violations,
        home,
    )
