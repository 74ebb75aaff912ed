"""Experiments that follow a network without a return to Python: each row on its own, until it ends or has its steps.

A step is that of :func:`emb_train.envs.closed_loop.advance`, so it is that of both environments, bit for bit.
"""

from __future__ import annotations

import numpy as np
from numba import prange
from numpy.typing import NDArray

from emb_bench.information.symmetric import Floats
from emb_runtime.config.plants import Instruments, Mechanics
from emb_runtime.safety.sensor_thresholds import SensorThresholds
from emb_runtime.safety.shield_design import ShieldLaw
from emb_train.envs.closed_loop import Experiments, Integers, Rules, Setup, advance_one
from emb_train.envs.conditions import Bools
from emb_train.envs.critic_view import Scale, describe_one

Singles = NDArray[np.float32]


# 11 levels of Lambert's continued fraction x/(1 + x²/(3 + x²/(5 + ...))), multiplied out: powers of x², lowest first.
ABOVE = (13749310575.0, 1964187225.0, 64324260.0, 675675.0, 2145.0, 1.0)
BELOW = (13749310575.0, 6547290750.0, 413513100.0, 7567560.0, 45045.0, 66.0)
TANH_END = 8.0  # Beyond it, tanh is 1 to the last digit but one of a float32


def tanh(x: np.float32) -> np.float32:
    """Hyperbolic tangent to 2e-6, without branches: a loop of it becomes vector code, four times as fast."""
    one = np.float32
    x = min(max(x, one(-TANH_END)), one(TANH_END))
    z = x * x
    above = one(ABOVE[3]) + z * (one(ABOVE[4]) + z * one(ABOVE[5]))
    above = one(ABOVE[0]) + z * (one(ABOVE[1]) + z * (one(ABOVE[2]) + z * above))
    below = one(BELOW[3]) + z * (one(BELOW[4]) + z * one(BELOW[5]))
    below = one(BELOW[0]) + z * (one(BELOW[1]) + z * (one(BELOW[2]) + z * below))
    return x * above / below


def multiply(w: Singles, b: Singles, seen: Singles, out: Singles) -> None:
    """Write ``seen`` w + b to ``out``; four inputs at a time, for reading and writing ``out`` is what takes time."""
    for j in range(w.shape[1]):
        out[j] = b[j]
    for i in range(0, w.shape[0], 4):
        s0, s1, s2, s3 = seen[i], seen[i + 1], seen[i + 2], seen[i + 3]
        for j in range(w.shape[1]):
            out[j] += s0 * w[i, j] + s1 * w[i + 1, j] + s2 * w[i + 2, j] + s3 * w[i + 3, j]


def perceive(weights: tuple[Singles, ...], biases: tuple[Singles, ...], work: Singles) -> int:
    """Linear layers with tanh between them, for one sample.

    Args:
        weights: of each layer, shape [inputs, outputs], with rows of zeros up to the next multiple of four inputs.
        biases: of each layer.
        work: the sample in its first row; two rows, as wide as the widest layer, without a NaN.

    Returns:
        The row of ``work`` in which the outputs are.
    """
    row = 0
    for layer in range(len(weights)):
        out = work[1 - row]
        multiply(weights[layer], biases[layer], work[row], out)
        if layer < len(weights) - 1:
            for j in range(biases[layer].shape[0]):
                out[j] = tanh(out[j])
        row = 1 - row
    return row


def follow(
    law: ShieldLaw,
    whole: ShieldLaw,
    thresholds: SensorThresholds,
    rules: Rules,
    mechanics: Mechanics,
    instruments: Instruments,
    chosen: Integers,
    scale: Scale,
    experiments: Experiments,
    limit: float,
    measured: bool,  # True if the network sees what is measured, else the head of the critic's observation
    centre: Singles,  # Of the network's normaliser, shape [I]
    span: Singles,  # The same
    weights: tuple[Singles, ...],
    biases: tuple[Singles, ...],
    made: Integers,  # Steps that each row has made of the T, shape [N]
    actor_seen: Singles,  # Becomes what the network saw, raw, shape [T, N, I]
    critic_seen: Singles,  # Becomes the critic's observations, shape [T, N, C]
    actions: Singles,  # Exploration; becomes the actions, not clipped, shape [T, N, 1]
    ms: Floats,  # Becomes the packed FIM after each step, shape [T, N, n (n + 1) / 2]
    xs: Floats,  # Becomes the true angle [rad] and velocity [rad/s] after each step, shape [T, N, 2]
    ks: Integers,  # Becomes the steps that the experiment has made, shape [T, N]
    left: Bools,  # Becomes whether the limits have been left, shape [T, N]
) -> None:
    """Take each row on until its experiment ends or it has made T steps, in place."""
    widest = 1
    for layer in range(len(weights)):
        widest = max(widest, weights[layer].shape[0], weights[layer].shape[1])
    x, m, y, k, violated = experiments.x, experiments.m, experiments.y, experiments.k, experiments.violated
    for i in prange(k.shape[0]):
        # No tuple of tuples gets into a parallel loop.
        setup = Setup(law, whole, thresholds, rules, mechanics, instruments, chosen)
        work = np.zeros((2, widest), np.float32)
        while made[i] < actions.shape[0] and not violated[i] and k[i] < rules.horizon:
            t = made[i]
            describe_one(scale, experiments, i, critic_seen[t, i])
            if measured:
                actor_seen[t, i, 0], actor_seen[t, i, 1], actor_seen[t, i, 2] = y[i, 0], y[i, 1], k[i]
            else:
                for j in range(centre.shape[0]):
                    actor_seen[t, i, j] = critic_seen[t, i, j]
            for j in range(centre.shape[0]):
                work[0, j] = (actor_seen[t, i, j] - centre[j]) / span[j]
            actions[t, i, 0] += work[perceive(weights, biases, work), 0]
            wanted = limit * min(max(float(actions[t, i, 0]), -1.0), 1.0)
            advance_one(setup, experiments, i, wanted)
            for j in range(m.shape[1]):
                ms[t, i, j] = m[i, j]
            xs[t, i, 0], xs[t, i, 1] = x[i, 0], x[i, 1]
            ks[t, i], left[t, i] = k[i], violated[i]
            made[i] += 1
