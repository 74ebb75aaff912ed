"""Brake steps per second: the compiled scalar functions against a named peer doing the same, in the same run.

    python benchmarks/brake.py

Absolute numbers belong to the machine and its load; the ratio travels. The first table is the Euler brake against plain
numpy, on one core each. The second is every kind of brake with the sensitivities to four parameters and their Fisher
information, a batch on all cores, against scipy's solve_ivp with events solving the same brake. Both sides compute the
same; the script stops if they do not.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from scipy.integrate import solve_ivp

from emb_bench.brake.euler import sensitivity_step, step
from emb_bench.brake.motion import SENSITIVE, STATES, advance, no_sensitivity
from emb_bench.compiled import compiled
from emb_bench.config.bench import load_bench
from emb_bench.config.plants import Mechanics
from emb_bench.information.fisher import physical_weights
from emb_bench.information.symmetric import Floats, add_increment, packed_size, unpack
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters

STEPS = 500
REPEATS = 5
BATCH = 2048
PLANTS = ("euler", "exact", "stribeck", "rough")
TARGETS = {"euler": 5e6, "exact": 2e6}  # Steps per second on two cores that the project set itself


def drive(p: BrakeParameters, x1: Floats, x2: Floats, u: Floats, t_s: float) -> None:
    """All brakes through all steps; states are changed in place."""
    for k in range(u.shape[0]):
        for e in range(x1.shape[0]):
            x1[e], x2[e] = step(p, x1[e], x2[e], u[k, e], t_s)


def learn(
    p: BrakeParameters, x1: Floats, x2: Floats, u: Floats, t_s: float, s: Floats, m: Floats, w1: float, w2: float
) -> None:
    """Simulates brakes with the sensitivities to four parameters and the packed FIM of each."""
    for k in range(u.shape[0]):
        for e in range(x1.shape[0]):
            for i in range(s.shape[1]):
                s[e, i, 0], s[e, i, 1] = sensitivity_step(p, x1[e], x2[e], u[k, e], t_s, s[e, i, 0], s[e, i, 1], i)
            x1[e], x2[e] = step(p, x1[e], x2[e], u[k, e], t_s)
            add_increment(m[e], s[e], w1, w2)


def numpy_drive(p: BrakeParameters, x1: Floats, x2: Floats, u: Floats, t_s: float) -> None:
    """Rival of :func:`drive`: one array operation at a time."""
    for current in u:
        torque = p.k_m * current - p.gamma * p.k_1 * np.maximum(x1, 0.0) - p.T_c * np.sign(x2) - p.f_v * x2
        x1 += t_s * x2
        x2 += t_s / p.J * torque


def numpy_learn(
    p: BrakeParameters, x1: Floats, x2: Floats, u: Floats, t_s: float, s: Floats, m: Floats, w1: float, w2: float
) -> None:
    """Rival of :func:`learn`; ``m`` has the shape (brakes, 4, 4)."""
    root = np.sqrt([w1, w2])
    for current in u:
        spring = np.where(x1 >= 0.0, p.gamma * p.k_1, 0.0)
        torques = np.stack([p.k_m * current, -spring * x1, -p.T_c * np.sign(x2), -p.f_v * x2], axis=1)
        change = torques - spring[:, None] * s[:, :, 0] - p.f_v * s[:, :, 1]
        s[:, :, 0] += t_s * s[:, :, 1]
        s[:, :, 1] += t_s / p.J * change
        x1 += t_s * x2
        x2 += t_s / p.J * torques.sum(axis=1)
        scaled = s * root
        m += scaled @ scaled.transpose(0, 2, 1)


Run = Callable[[tuple[Floats, ...]], None]


def best_rate(run: Run, shapes: list[tuple[int, ...]]) -> tuple[float, list[Floats]]:
    """Steps per second of the fastest of some runs from zero, and what the last one ended with."""
    fastest = np.inf
    for _ in range(REPEATS + 1):  # the first one compiles
        arrays = [np.zeros(shape) for shape in shapes]
        start = time.perf_counter()
        run(tuple(arrays))
        fastest = min(fastest, time.perf_counter() - start)
    return STEPS * shapes[0][0] / fastest, arrays


def report(name: str, count: int, ours: tuple[float, list[Floats]], rival: tuple[float, list[Floats]]) -> None:
    """Print one line, after checking that both computed the same."""
    for found, expected in zip(ours[1], rival[1], strict=True):
        same = unpack(found, expected.shape[-1]) if found.ndim < expected.ndim else found
        np.testing.assert_allclose(same, expected, rtol=1e-6, atol=1e-6)
    print(f"{name:<44}{count:>7}{ours[0] / 1e6:>16.1f}{rival[0] / 1e6:>13.2f}{ours[0] / rival[0]:>7.1f}")


def measure(count: int) -> None:
    """Both kinds of work for one number of brakes."""
    bench = load_bench()
    p, t_s = bench.brake, bench.timing.sample_time
    w1, w2 = physical_weights(bench.noise)
    u = np.random.default_rng(0).uniform(-3.0, 3.0, (STEPS // 20, count)).repeat(20, axis=0)
    states: list[tuple[int, ...]] = [(count,), (count,)]

    def driving(loop: Callable[..., None]) -> Run:
        return lambda arrays: loop(p, *arrays, u, t_s)

    def learning(loop: Callable[..., None]) -> Run:
        return lambda arrays: loop(p, *arrays[:2], u, t_s, *arrays[2:], w1, w2)

    report("steps", count, best_rate(driving(compiled(drive)), states), best_rate(driving(numpy_drive), states))
    report(
        "steps, 4 sensitivities, Fisher information",
        count,
        best_rate(learning(compiled(learn)), [*states, (count, 4, 2), (count, packed_size(4))]),
        best_rate(learning(numpy_learn), [*states, (count, 4, 2), (count, 4, 4)]),
    )


def learn_batch(
    mechanics: Mechanics,
    p: BrakeParameters,
    u: Any,
    t_s: float,
    unknowns: Any,
    x: Any,
    s: Any,
    m: Any,
    w1: float,
    w2: float,
) -> None:
    """Many brakes of any kind, each through all its steps, with sensitivities and packed FIM."""
    for e in numba.prange(x.shape[0]):
        for k in range(u.shape[1]):
            advance(mechanics, p, x[e], u[e, k], t_s, unknowns, s[e])
            add_increment(m[e], s[e], w1, w2)


def solve(p: BrakeParameters, u: Floats, t_s: float) -> Floats:
    """Rival: one brake through its steps by a general solver that looks for events; states at the samples."""
    state, states = np.zeros(2), []
    for current in u:
        remaining = t_s
        while remaining > 0.0:
            pull = p.k_m * current - p.gamma * p.k_1 * max(state[0], 0.0)
            if state[1] == 0.0 and abs(pull) <= p.T_c:
                break
            direction = np.sign(state[1] or pull)

            def rate(_t: float, y: Floats, i: float = float(current), d: float = direction) -> list[float]:
                torque = p.k_m * i - p.gamma * p.k_1 * max(y[0], 0.0) - d * p.T_c - p.f_v * y[1]
                return [y[1], torque / p.J]

            def rest(_t: float, y: Floats, d: float = direction) -> float:
                return float(y[1] * d)

            rest.terminal, rest.direction = True, -1  # type: ignore[attr-defined]
            found = solve_ivp(rate, (0.0, remaining), state, "DOP853", events=rest, rtol=1e-9, atol=1e-9)
            remaining -= float(found.t[-1])
            state = found.y[:, -1].copy()
            if found.status == 1:
                state[1] = 0.0
        states.append(state.copy())
    return np.array(states)


def batches() -> None:
    """Every kind of brake, a batch on all cores; the exact one beside the general solver."""
    bench = load_bench()
    p, t_s = bench.brake, bench.timing.sample_time
    weights = physical_weights(bench.noise)
    u = np.random.default_rng(0).uniform(-3.0, 3.0, (BATCH, STEPS // 20)).repeat(20, axis=1)
    unknowns, _ = no_sensitivity(PARAMETER_NAMES)
    run = compiled(learn_batch, parallel=True)
    start = time.perf_counter()
    expected = solve(p, u[0], t_s)
    peer = STEPS / (time.perf_counter() - start)
    threads = numba.get_num_threads()
    work = f"4 sensitivities, {threads} threads"
    print(f"\n{work:<36}{'[M/s]':>8}{'target':>8}{'solve_ivp, state only':>23}{'ratio':>8}")
    rates = {}
    for name in PLANTS:
        fastest = np.inf
        for _ in range(REPEATS + 1):
            x, s = np.zeros((BATCH, STATES)), np.zeros((BATCH, len(unknowns), SENSITIVE))
            m = np.zeros((BATCH, packed_size(len(unknowns))))
            start = time.perf_counter()
            run(bench.plant(name).mechanics, p, u, t_s, unknowns, x, s, m, *weights)
            fastest = min(fastest, time.perf_counter() - start)
        if name == "exact":
            np.testing.assert_allclose(x[0, :2], expected[-1], rtol=1e-6, atol=1e-6)
        rates[name] = rate = u.size / fastest
        target = f"{TARGETS[name] / 1e6:.0f}" if name in TARGETS else ""
        print(f"{f'{name}, {BATCH} brakes':<36}{rate / 1e6:>8.2f}{target:>8}{peer / 1e6:>23.4f}{rate / peer:>8.0f}")
    text = ", ".join(f"{name} {rate / 1e6:.2g}" for name, rate in rates.items())
    print(f"| brake with 4 sensitivities and information, {threads} threads | – | {text} M steps/s |")
    print(f"| exact brake over scipy's `solve_ivp`, state alone: speed | – | {rates['exact'] / peer:,.0f} |")


if __name__ == "__main__":
    print(f"{'work':<44}{'brakes':>7}{'compiled [M/s]':>16}{'numpy [M/s]':>13}{'ratio':>7}")
    for brakes in (4, 64, 256, 1024):
        measure(brakes)
    batches()
