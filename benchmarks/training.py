"""How fast training is, and what the trained actor is worth beside excitations that need no learning.

`python benchmarks/training.py [--steps N]` trains the shipped preset, times it, times the thesis's scheme in the same
process (4 Gymnasium environments in plain Python, the Fisher information by automatic differentiation in every step,
10 epochs of 32 minibatches), and prints the table on the 40-value grid of f_v. A machine that does other things at the
same time slows both schemes: the ratio says more than the speed.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from emb_bench.brake.euler import step
from emb_bench.information import thesis_weights
from emb_runtime.bench import Bench, load_bench
from emb_train.checkpoint import begin_directory
from emb_train.env import EmbExcitationEnv
from emb_train.networks import Actor, Critic
from emb_train.ppo import Learner, PpoConfig, collect
from emb_train.presets import load_preset
from emb_train.train import evaluate, table, train
from emb_train.vector_env import EmbExcitationVectorEnv

THESIS_SPEED = 1_000_000 / (35 * 60)
"""Environment steps per second: 1 M in 35 minutes (thesis 5.2.2)."""

THESIS_SCHEME = PpoConfig(
    total_steps=8192, envs=4, rollout=2048, minibatch=256, epochs=10, gamma=0.99, gae_lambda=0.95, learning_rate=1e-3
)


class AutogradInformation:
    """The Fisher information of f_v by automatic differentiation of every step, as in section 4.3.5 of the thesis."""

    def __init__(self, bench: Bench) -> None:
        self._brake = bench.brake
        self._sample_time = bench.timing.sample_time
        self._weights = thesis_weights(bench.noise, bench.limits)
        self._sensitivity = torch.zeros(2, dtype=torch.float64)
        self.total = 0.0

    def add(self, x: np.ndarray, current: float) -> None:
        """Add the information of the step that begins in state ``x`` [rad, rad/s] with ``current`` [A]."""
        at = torch.tensor([*x, 1.0], dtype=torch.float64, requires_grad=True)
        brake = self._brake._replace(f_v=self._brake.f_v * at[2])  # type: ignore[arg-type]  # a tensor for a float
        after: Any = step(brake, at[0], at[1], current, self._sample_time)  # type: ignore[arg-type]  # the same
        rows = [torch.autograd.grad(value, at, retain_graph=True)[0] for value in after]
        jacobian = torch.stack(rows)
        self._sensitivity = jacobian[:, :2] @ self._sensitivity + jacobian[:, 2]
        angle, velocity = self._sensitivity.tolist()
        self.total += self._weights.angle * angle**2 + self._weights.velocity * velocity**2


def thesis_scheme_speed(bench: Bench, seconds: float) -> float:
    """Steps per second of the thesis's scheme: rollout in plain Python with automatic differentiation, then updates."""
    config = THESIS_SCHEME
    envs = [EmbExcitationEnv(bench) for _ in range(config.envs)]
    fast = EmbExcitationVectorEnv(config.envs, bench)
    actor = Actor(bench, config.hidden, 0.0, 0.5)
    learner = Learner(fast, actor, Critic(fast.critic_size, config.hidden), config, 0)
    generator = torch.Generator().manual_seed(0)

    information = [AutogradInformation(bench) for _ in envs]
    same = {"brake": bench.brake}  # the one that the automatic differentiation is told of
    seen = np.stack([env.reset(seed=i, options=same)[0] for i, env in enumerate(envs)])
    steps, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        with torch.no_grad():
            actions = actor(torch.from_numpy(seen)).numpy()
        for i, env in enumerate(envs):
            x = env.state
            seen[i], _, terminated, _, info = env.step(actions[i])
            information[i].add(x, info["current"])
            if terminated:
                if not np.isclose(information[i].total, info["fim"][0], rtol=1e-9):
                    raise SystemExit(f"autograd says {information[i].total}, the environment {info['fim'][0]}")
                seen[i], _ = env.reset(options=same)
                information[i] = AutogradInformation(bench)
        steps += len(envs)
    rollout_time = (time.perf_counter() - start) / steps

    rollout = collect(fast, actor, config.rollout, 0.0, list(range(config.envs)), generator)
    start = time.perf_counter()
    learner.improve(rollout, generator)
    return 1.0 / (rollout_time + (time.perf_counter() - start) / config.batch)


def main() -> None:
    """Run the benchmark."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--steps", type=int, help="environment steps of the training (default: the preset's)")
    steps = p.parse_args().steps
    config, bench = load_preset("single-viscous"), load_bench()
    if steps is not None:
        config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, total_steps=steps))

    start = time.perf_counter()
    env = EmbExcitationVectorEnv(2, bench)
    env.reset(seed=0)
    env.step(np.zeros((2, 1), np.float32))
    print(f"compiling, once per machine               {time.perf_counter() - start:10.1f} s")
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder) / "run"
        begin_directory(directory, config, bench)
        start = time.perf_counter()
        train(directory, config, bench)
        speed = config.ppo.iterations * config.ppo.batch / (time.perf_counter() - start)
        scheme = thesis_scheme_speed(bench, 5.0)
        print(f"rollout, information and updates          {speed:10,.0f} steps/s, torch threads {config.ppo.threads}")
        print(f"time for 1 M steps                        {1e6 / speed:10.1f} s")
        print(f"the thesis's scheme in this process       {scheme:10,.0f} steps/s, ratio {speed / scheme:.0f}")
        print(
            f"the thesis, on its machine                {THESIS_SPEED:10,.0f} steps/s, ratio {speed / THESIS_SPEED:.0f}"
        )
        print(table(evaluate(directory)))


if __name__ == "__main__":
    main()
