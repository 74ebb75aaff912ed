"""Brake steps per second: the compiled scalar functions against plain numpy doing the same, in the same run.

    python benchmarks/brake.py

Absolute numbers belong to the machine and its load; the ratio travels. Both sides are on one core and compute the same
trajectories, sensitivities and Fisher information; the script stops if they do not.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from emb_bench.brake.euler import sensitivity_step, step
from emb_bench.compiled import compiled
from emb_bench.information import physical_weights
from emb_bench.packed import Floats, add_increment, packed_size, unpack
from emb_runtime.bench import BrakeParameters, load_bench

STEPS = 500
REPEATS = 5


def drive(p: BrakeParameters, x1: Floats, x2: Floats, u: Floats, t_s: float) -> None:
    """All brakes through all steps; states are changed in place."""
    for k in range(u.shape[0]):
        for e in range(x1.shape[0]):
            x1[e], x2[e] = step(p, x1[e], x2[e], u[k, e], t_s)


def learn(
    p: BrakeParameters, x1: Floats, x2: Floats, u: Floats, t_s: float, s: Floats, m: Floats, w1: float, w2: float
) -> None:
    """The same, with the sensitivities to four parameters and the packed FIM of each brake."""
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
        own = np.stack([p.k_m * current, -spring * x1, -p.T_c * np.sign(x2), -p.f_v * x2], axis=1)
        change = own - spring[:, None] * s[:, :, 0] - p.f_v * s[:, :, 1]
        s[:, :, 0] += t_s * s[:, :, 1]
        s[:, :, 1] += t_s / p.J * change
        x1 += t_s * x2
        x2 += t_s / p.J * own.sum(axis=1)
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


if __name__ == "__main__":
    print(f"{'work':<44}{'brakes':>7}{'compiled [M/s]':>16}{'numpy [M/s]':>13}{'ratio':>7}")
    for brakes in (4, 64, 256, 1024):
        measure(brakes)
