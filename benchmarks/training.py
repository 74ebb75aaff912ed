"""Speed of training, and the information of the trained actor beside excitations that need no learning.

`python benchmarks/training.py [--steps N] [--seconds S]` trains the shipped preset, times it, and times in the same
process, after it:

* the thesis's scheme: 4 Gymnasium environments in plain Python, the Fisher information by automatic differentiation in
  every step, 10 epochs of 32 minibatches, autograd;
* Stable-Baselines3's PPO on the same batched environment with the same network widths, minibatches and epochs;
* our own learner with the thesis's hyper-parameters.

Then all of them train for the same time, S seconds of wall clock, and it prints what each actor is worth on the
40-value grid of f_v. A machine that does other things at the same time slows all: the ratios say more than the speeds.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from emb_bench.brake.euler import step
from emb_bench.information.fisher import thesis_weights
from emb_runtime.config.bench import Bench, BrakeParameters, load_bench
from emb_train.cli.train import evaluate, table
from emb_train.envs.env import EmbExcitationEnv, EmbExcitationVectorEnv
from emb_train.envs.excitations import Network
from emb_train.envs.play import run_grid
from emb_train.ppo.networks import Actor, Critic, DeployedActor
from emb_train.ppo.ppo import Learner, PpoConfig, generalised_advantages, normalised
from emb_train.presets import load_preset
from emb_train.training.checkpoint import begin_directory
from emb_train.training.configuration import Configuration
from emb_train.training.loop import train

THESIS_SPEED = 1_000_000 / (35 * 60)  # Environment steps per second: 1 M in 35 minutes (thesis 5.2.2)
THESIS: Mapping[str, Any] = {"envs": 4, "rollout": 2048, "minibatch": 256, "epochs": 10}
"""Its hyper-parameters that cost time (5.2)."""
LIMITS = {"training": 150_000.0, "1 M": 10.0, "scheme": 100.0, "sb3": 1.0, "thesis": 18_000.0}


class AutogradInformation:
    """The Fisher information of f_v by automatic differentiation of every step, as in section 4.3.5 of the thesis."""

    def __init__(self, bench: Bench, env: EmbExcitationEnv) -> None:
        self._brake = BrakeParameters(*env._batch.brakes[0].tolist())
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


class ThesisScheme:
    """The thesis's way to train, around this environment: every number that it needs is computed as it did."""

    def __init__(self, config: Configuration, bench: Bench) -> None:
        """Begin; ``config`` has the thesis's hyper-parameters."""
        ppo = config.ppo
        self._ppo, self._bench, self._scale = ppo, bench, config.reward.scale  # type: ignore[attr-defined]
        self._envs = [
            EmbExcitationEnv(bench, config.ranges, config.parameters, config.reward, config.plant)
            for _ in range(ppo.envs)
        ]
        torch.manual_seed(config.seed)
        self.actor = Actor(bench, ppo.hidden, ppo.initial_mean, ppo.initial_deviation)
        self._critic = Critic(EmbExcitationVectorEnv(1, bench).critic_size, ppo.hidden)
        parameters = [*self.actor.parameters(), *self._critic.parameters()]
        self._optimiser = torch.optim.Adam(parameters, lr=ppo.learning_rate, eps=1e-5)
        self._states = [env.reset(seed=i) for i, env in enumerate(self._envs)]
        self._information = [AutogradInformation(bench, env) for env in self._envs]
        self.steps = 0

    def iterate(self, until: float) -> None:
        """One rollout and its improvement, or what fits before the clock reaches ``until``."""
        kept = []
        for _ in range(self._ppo.rollout):
            seen = torch.from_numpy(np.stack([state[0] for state in self._states]))
            critic_seen = torch.from_numpy(np.stack([state[1]["critic"] for state in self._states]))
            with torch.no_grad():
                action = self.actor(seen) + self.actor.log_deviation.exp() * torch.randn(len(self._envs), 1)
            rewards, ends = [], []
            for i, env in enumerate(self._envs):
                x, before = env.state, self._information[i].total
                observation, _, terminated, _, info = env.step(action[i].numpy())
                self._information[i].add(x, info["current"])
                rewards.append(self._scale * (self._information[i].total - before))
                if terminated and not np.isclose(self._information[i].total, info["fim"][0], rtol=1e-9):
                    raise SystemExit(f"autograd says {self._information[i].total}, the environment {info['fim'][0]}")
                ends.append(float(terminated))
                self._states[i] = env.reset() if terminated else (observation, info)
                if terminated:
                    self._information[i] = AutogradInformation(self._bench, env)
            kept.append((seen, critic_seen, action, torch.tensor(rewards), torch.tensor(ends)))
            self.steps += len(self._envs)
            if time.perf_counter() >= until:
                return
        self._improve([torch.stack(column) for column in zip(*kept, strict=True)])

    def _improve(self, columns: Sequence[torch.Tensor]) -> None:
        ppo, actor, critic = self._ppo, self.actor, self._critic
        seen, critic_seen, actions, rewards, ends = columns
        normal: Any = torch.distributions.Normal

        def density(index: slice | torch.Tensor) -> torch.Tensor:
            result: torch.Tensor = normal(actor(flat[0][index]), actor.log_deviation.exp()).log_prob(flat[1][index])
            return result.squeeze(-1)

        flat = seen.flatten(0, 1), actions.flatten(0, 1), critic_seen.flatten(0, 1)
        with torch.no_grad():
            values, old = critic(flat[2]).view_as(rewards), density(slice(None))
            last = critic(torch.from_numpy(np.stack([state[1]["critic"] for state in self._states])))
            raw = generalised_advantages(rewards, values, ends, last, ppo.gamma, ppo.gae_lambda)
            advantages, returns = normalised(raw.flatten()), (raw + values).flatten()
        for _ in range(ppo.epochs):
            shuffled = torch.randperm(len(old))
            for start in range(0, len(old), ppo.minibatch):
                index = shuffled[start : start + ppo.minibatch]
                ratio = (density(index) - old[index]).exp()
                gain = torch.minimum(
                    ratio * advantages[index], ratio.clamp(1 - ppo.clip, 1 + ppo.clip) * advantages[index]
                )
                error = 0.5 * (critic(flat[2][index]) - returns[index]).square().mean()
                self._optimiser.zero_grad()
                (error - gain.mean() - ppo.entropy * actor.log_deviation.sum()).backward()
                for network in (actor, critic):
                    torch.nn.utils.clip_grad_norm_(network.parameters(), ppo.max_gradient)
                self._optimiser.step()


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
    learner._collect(actor, ppo.rollout, 0.0, list(range(ppo.envs)), torch.Generator(), 1)  # what there is to compile
    start = time.perf_counter()
    while time.perf_counter() - start < seconds and not learner.finished:
        learner.iterate()
    speed = learner.iteration * ppo.batch / (time.perf_counter() - start)
    return speed, Network(DeployedActor(actor, bench.limits.current))


def thesis_scheme(config: Configuration, bench: Bench, seconds: float) -> tuple[float, Network]:
    """Trains with the thesis's scheme."""
    scheme = ThesisScheme(config, bench)
    start = time.perf_counter()
    while time.perf_counter() - start < seconds:
        scheme.iterate(start + seconds)
    speed = scheme.steps / (time.perf_counter() - start)
    return speed, Network(DeployedActor(scheme.actor, bench.limits.current))


def verdict(value: float, limit: float, least: bool = True) -> str:
    """Returns a text on whether a limit is met."""
    met = value >= limit if least else value <= limit
    return f"{'at least' if least else 'at most'} {limit:,.0f}: {'met' if met else 'NOT met'}"


def main() -> None:
    """Run the benchmark."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--steps", type=int, help="environment steps of the training (default: the preset's)")
    p.add_argument("--seconds", type=float, default=20.0, help="wall clock of each contestant (default: %(default)g)")
    arguments = p.parse_args()
    config, bench = load_preset("single-viscous"), load_bench()
    if arguments.steps is not None:
        config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, total_steps=arguments.steps))
    slow = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, **THESIS))

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
        "ours, the thesis's hyper-parameters": ours(slow, bench, arguments.seconds),
        "Stable-Baselines3, same environment": stable_baselines(config, bench, arguments.seconds),
        "the thesis's scheme": thesis_scheme(slow, bench, arguments.seconds),
    }
    _, at_thesis, sb3, scheme = (s for s, _ in candidates.values())
    rows = [
        ("rollout, information, updates, files", f"{speed:,.0f} steps/s", verdict(speed, LIMITS["training"])),
        ("time for 1 M steps", f"{1e6 / speed:.1f} s", verdict(1e6 / speed, LIMITS["1 M"], False)),
        ("ours, the thesis's hyper-parameters", f"{at_thesis:,.0f} steps/s", verdict(at_thesis, LIMITS["thesis"])),
        ("the thesis's scheme in this process", f"{scheme:,.0f} steps/s", ""),
        ("  ratio", f"{speed / scheme:.0f}", verdict(speed / scheme, LIMITS["scheme"])),
        ("Stable-Baselines3, same environment", f"{sb3:,.0f} steps/s", ""),
        ("  ratio", f"{speed / sb3:.2f}", verdict(speed / sb3, LIMITS["sb3"])),
        ("the thesis, on its machine", f"{THESIS_SPEED:,.0f} steps/s", ""),
        ("  ratio", f"{speed / THESIS_SPEED:.0f}", ""),
    ]
    for name, value, limit in rows:
        print(f"{name:<42}{value:>18}  {limit}")
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
