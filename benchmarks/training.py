"""Speed of training and worth of the trained actor, beside PPO of Stable-Baselines3 on the same environment in one run.

    python benchmarks/training.py [--steps N] [--seconds S]

Trains the preset of f_v and times it; then our learner and Stable-Baselines3's train for S seconds of wall clock each,
with the same network widths, minibatches and epochs, and each actor is valued on the 40-value grid of f_v.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from emb_runtime.config.bench import Bench, load_bench
from emb_train.cli.train import evaluate, table
from emb_train.envs.env import EmbExcitationVectorEnv
from emb_train.envs.excitations import Network
from emb_train.envs.play import run_grid
from emb_train.ppo.networks import Actor, Critic, DeployedActor
from emb_train.ppo.ppo import Learner, PpoConfig
from emb_train.ppo.rollout import collect
from emb_train.presets import load_preset
from emb_train.training.checkpoint import begin_directory
from emb_train.training.configuration import Configuration
from emb_train.training.loop import train

RATIO = 1.0  # Steps per second over those of Stable-Baselines3, at least


class Batched(VecEnv):
    """Our batched environment as Stable-Baselines3 expects it; observations scaled as our actor scales them."""

    def __init__(self, env: EmbExcitationVectorEnv, scale: Callable[[np.ndarray], np.ndarray]) -> None:
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._env, self._scale = env, scale
        self._actions = np.zeros((env.num_envs, 1), np.float32)

    def reset(self) -> Any:
        """Begin all experiments."""
        return self._scale(self._env.reset(seed=0)[0])

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> Any:
        """One step of all experiments; what ended has begun again."""
        seen, rewards, ended, _, info = self._env.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(ended):
            infos[i] = {"terminal_observation": self._scale(info["final_obs"])[i], "TimeLimit.truncated": False}
        return self._scale(seen), rewards.astype(np.float32), ended, infos

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Only what Stable-Baselines3 requires."""
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Nothing can be set."""

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """There are no methods to call."""
        raise NotImplementedError(method_name)

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Nothing is wrapped."""
        return [False] * self.num_envs


class _Until(BaseCallback):
    def __init__(self, until: float) -> None:
        super().__init__()
        self._until = until

    def _on_step(self) -> bool:
        return time.perf_counter() < self._until


def stable_baselines(config: Configuration, bench: Bench, seconds: float) -> tuple[float, Network]:
    """Steps per second of Stable-Baselines3's PPO in that time, and what it has learned."""
    ppo = config.ppo
    actor = Actor(bench, ppo.hidden, ppo.initial_mean, ppo.initial_deviation)
    centre, span = actor.centre.numpy(), actor.span.numpy()
    env = Batched(
        EmbExcitationVectorEnv(ppo.envs, bench, config.ranges, config.parameters, config.reward, config.plant),
        lambda seen: (seen - centre) / span,
    )
    env._env.reset(seed=0)
    env._env.step(np.zeros((ppo.envs, 1), np.float32))
    model = PPO(
        "MlpPolicy",
        env,
        learning_rate=ppo.learning_rate,
        n_steps=ppo.rollout,
        batch_size=ppo.minibatch,
        n_epochs=ppo.epochs,
        gamma=ppo.gamma,
        gae_lambda=ppo.gae_lambda,
        clip_range=ppo.clip,
        ent_coef=ppo.entropy,
        vf_coef=0.5,
        max_grad_norm=ppo.max_gradient,
        policy_kwargs={"net_arch": list(ppo.hidden), "activation_fn": torch.nn.Tanh},
        seed=config.seed,
        device="cpu",
    )
    start = time.perf_counter()
    model.learn(10**12, callback=_Until(start + seconds))
    speed = model.num_timesteps / (time.perf_counter() - start)

    class Mean(torch.nn.Module):
        def forward(self, seen: torch.Tensor) -> torch.Tensor:
            gaussian: Any = model.policy.get_distribution((seen - actor.centre) / actor.span).distribution
            mean: torch.Tensor = gaussian.mean
            return bench.limits.current * mean.clamp(-1.0, 1.0)

    return speed, Network(Mean())


def ours(config: Configuration, bench: Bench, seconds: float) -> tuple[float, Network]:
    """Trains with our own learner; its learning rate falls over all of its steps."""
    ppo = config.ppo
    torch.manual_seed(config.seed)
    env = EmbExcitationVectorEnv(ppo.envs, bench, config.ranges, config.parameters, config.reward, config.plant)
    actor = Actor(bench, ppo.hidden, ppo.initial_mean, ppo.initial_deviation)
    learner = Learner(env, actor, Critic(env.critic_size, ppo.hidden), ppo, config.seed)
    collect(env, actor, ppo.rollout, 0.0, list(range(ppo.envs)), torch.Generator(), 1)  # what there is to compile
    start = time.perf_counter()
    while time.perf_counter() - start < seconds and not learner.finished:
        learner.iterate()
    speed = learner.iteration * ppo.batch / (time.perf_counter() - start)
    return speed, Network(DeployedActor(actor, bench.limits.current))


def main() -> None:
    """Run the benchmark."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--steps", type=int, help="environment steps of the training (default: the preset's)")
    p.add_argument("--seconds", type=float, default=20.0, help="wall clock of each contestant (default: %(default)g)")
    arguments = p.parse_args()
    config, bench = load_preset("single-viscous"), load_bench()
    if arguments.steps is not None:
        config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, total_steps=arguments.steps))

    start = time.perf_counter()
    ours(dataclasses.replace(config, ppo=PpoConfig(total_steps=1, envs=2)), bench, 0.0)
    print(f"compiling, once per machine               {time.perf_counter() - start:10.1f} s")
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder) / "run"
        begin_directory(directory, config, bench)
        start = time.perf_counter()
        train(directory, config, bench)
        speed = config.ppo.iterations * config.ppo.batch / (time.perf_counter() - start)
        result = table(evaluate(directory))
    torch.set_num_threads(1)
    candidates = {
        "ours": ours(config, bench, arguments.seconds),
        "Stable-Baselines3, same environment": stable_baselines(config, bench, arguments.seconds),
    }
    sb3 = candidates["Stable-Baselines3, same environment"][0]
    print(f"training, with its files                  {speed:10,.0f} steps/s; 1 M in {1e6 / speed:.1f} s")
    print(f"Stable-Baselines3, same environment       {sb3:10,.0f} steps/s")
    print(f"  ratio                                   {speed / sb3:10.2f} (at least {RATIO})")
    print(f"\nmean weighted information on the grid after {arguments.seconds:g} s of wall clock")
    excitations = [network for _, network in candidates.values()]
    found = run_grid(
        bench, bench.range_set(config.ranges), config.parameters[0], excitations, config.seed, config.plant
    )
    for name, one in zip(candidates, found, strict=True):
        print(f"{name:<42}{one.mean:10.4e}, {one.violations} violations, home {one.home}/{len(one.fim)}")
    print(f"\nafter {config.ppo.total_steps:,} steps\n{result}")


if __name__ == "__main__":
    main()
