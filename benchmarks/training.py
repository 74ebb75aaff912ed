"""Worth of what the preset of f_v learns, and speed beside PPO of Stable-Baselines3 on the same environment.

    python benchmarks/training.py [--seeds N] [--seconds S]

Our PPO and Stable-Baselines3's train for S seconds of processor time each, in turns, with the same network widths,
minibatches and epochs. Then the preset is trained with N seeds, and each actor is valued on the 40-value grid of f_v,
beside the best single switch between the largest currents that is found there.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

sys.path.insert(0, str(Path(__file__).parents[1]))

from emb_bench.config.bench import Bench, load_bench
from emb_train.env import EmbExcitationVectorEnv
from emb_train.play import APPLIED, STEP, Currents, Excitation, Outcome, Seen, play
from emb_train.ppo import DeployedActor, train
from emb_train.training import Trained, Training, begin_training, load_preset, run_training
from studies.thesis.trainings import grid_draws

WORTH = 2.737e7  # Mean information on the grid, at least
RATIO = 1.5  # Steps per second over those of Stable-Baselines3, at least
TURNS = 3


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


def stable_baselines(training: Training, bench: Bench, seconds: float) -> float:
    """Steps per second of processor time of Stable-Baselines3's PPO."""
    ppo, actor = training.ppo, training.untrained_actor(bench)
    (envs,) = training.environments(bench, ppo.envs)
    env = Batched(envs, lambda seen: actor.features(torch.from_numpy(seen)).numpy())
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
        seed=training.seed,
        device="cpu",
    )
    start = time.process_time()
    model.learn(ppo.batch)  # an iteration, as ours: a rollout and what is learned from it
    while time.process_time() - start < seconds:
        model.learn(ppo.batch, reset_num_timesteps=False)
    return model.num_timesteps / (time.process_time() - start)


def ours(training: Training, bench: Bench, seconds: float) -> float:
    """Steps per second of processor time of our PPO."""
    envs, actor = training.environments(bench, training.ppo.envs), training.untrained_actor(bench)
    start = time.process_time()
    iterations = train(envs, actor, training.ppo, training.seed)
    steps = next(iterations).steps
    while time.process_time() - start < seconds:
        steps = next(iterations).steps
    return steps / (time.process_time() - start)


class Network:
    """A trained actor, without exploration."""

    def __init__(self, actor: DeployedActor) -> None:
        self._actor = actor

    def __call__(self, seen: Seen) -> Currents:
        """See :data:`emb_train.play.Excitation`."""
        with torch.no_grad():
            currents = self._actor(torch.from_numpy(np.ascontiguousarray(seen[:, :APPLIED])))
        return np.array(currents[:, 0].numpy(), np.float64)


def on_grid(trained: Trained, training: Training, bench: Bench) -> dict[str, Outcome]:
    """The trained actor and the best open-loop switch on the grid, with the same noise."""
    ranges, limit, horizon = bench.range_set(training.ranges), bench.limits.current, bench.timing.horizon
    draws = grid_draws(ranges, training.parameters[0], training.seed)

    def played(excitation: Excitation) -> Outcome:
        return play(bench, ranges, training.parameters, excitation, draws, training.plants[0], training.conditions)

    def switched(u: float, t: int) -> Outcome:
        return played(lambda seen: np.where(seen[:, STEP] < t, u, -u))

    blind = {}
    for u in (limit, -limit):
        for t in range(horizon // 100, horizon + 1, horizon // 100):  # the last is no switch at all
            blind[f"{u:+g} A, from step {t} {-u:+g} A"] = switched(u, t)
    best = max(blind, key=lambda name: float(blind[name].matrices.mean()))
    return {"trained actor": played(Network(DeployedActor(trained.actor, limit))), best: blind[best]}


def main() -> None:
    """Run the benchmark."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--seeds", type=int, default=3, help="trainings of the preset (default: %(default)s)")
    p.add_argument("--seconds", type=float, default=10.0, help="of each contestant's turns (default: %(default)g)")
    arguments = p.parse_args()
    bench, training = load_bench(), load_preset("single-viscous")
    torch.set_num_threads(1)
    ours(training, bench, 0.0)  # what there is to compile
    speeds = [(ours(training, bench, arguments.seconds), stable_baselines(training, bench, arguments.seconds))
              for _ in range(TURNS)]  # fmt: skip
    ratios = [our_speed / other for our_speed, other in speeds]
    our_speed, other = np.median(speeds, axis=0)
    print(
        f"ours {our_speed:,.0f} steps/s, Stable-Baselines3 {other:,.0f} steps/s, of processor time, "
        f"medians of {TURNS} turns"
    )
    ratio, missed = float(np.median(ratios)), "" if np.median(ratios) >= RATIO else ", **not met**"
    print(
        f"| training speed over that of Stable-Baselines3, {TURNS} turns | at least {RATIO} | {ratio:.2f} "
        f"({min(ratios):.2f} to {max(ratios):.2f}){missed} |"
    )
    actors = []
    for seed in range(arguments.seeds):
        with tempfile.TemporaryDirectory() as directory:
            folder, training = Path(directory) / "run", load_preset("single-viscous", seed=seed)
            begin_training(folder, training, bench)
            *_, trained = run_training(folder, training, bench)
        outcomes = on_grid(trained, training, bench)
        actors.append(outcomes["trained actor"])
        for name, o in outcomes.items():
            worth = f"{o.matrices[:, 0, 0].mean():.4e}"
            print(f"seed {seed}, {name}: {worth}, {o.violated.sum()} left, home {o.home.sum()}/40")
    if actors:
        means = [float(o.matrices[:, 0, 0].mean()) for o in actors]
        left, home = (sum(int(getattr(o, key).sum()) for o in actors) for key in ("violated", "home"))
        print(
            f"| PPO, preset of f_v, {training.ppo.total_steps / 1e6:g} M steps, {len(actors)} seeds: mean weighted "
            f"information on the grid; violations; home | {WORTH:.3e}; 0; all | {min(means):.3e} to {max(means):.3e}; "
            f"{left}; {home} of {40 * len(actors)} |"
        )


if __name__ == "__main__":
    main()
