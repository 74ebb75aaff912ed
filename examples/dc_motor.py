"""Another plant: a DC motor with inertia, whose torque constant, inertia and friction are unknown by ±50 %.

    python examples/dc_motor.py [--out motor.onnx] [--steps N]

A voltage of up to 12 V drives it for 0.2 s. Current and speed are measured, and must stay below 5 A and 100 rad/s: full
voltage would leave both limits, and there is no shield. The actor, who does not know the parameters, learns that by
losing what it had. The description of the plant ends at PLANT; the rest is training, comparison and export.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emb_export.plant import export_actor
from emb_runtime.system.terminal import show
from emb_train.plants.interface import Output, Parameter, Plant
from emb_train.plants.learning import Control, controlled_by, learn, play
from emb_train.ppo.ppo import PpoConfig

Floats = NDArray[np.float64]


def step(p: Floats, x: Floats, u: float, t_s: float, out: Floats) -> None:
    """L di/dt = u − R i − K ω and J dω/dt = K i − b ω, ten Euler steps in a period."""
    resistance, inductance, torque, inertia, friction = p
    current, speed = x
    for _ in range(10):
        slope = (u - resistance * current - torque * speed) / inductance
        speed += 0.1 * t_s * (torque * current - friction * speed) / inertia
        current += 0.1 * t_s * slope
    out[0], out[1] = current, speed


def observe(_p: Floats, x: Floats, out: Floats) -> None:
    """Both states are measured."""
    out[0], out[1] = x[0], x[1]


PLANT = Plant(
    name="dc motor",
    step=step,
    observe=observe,
    parameters=(
        Parameter("R", "Ohm", 1.0, 1.0),
        Parameter("L", "H", 2e-3, 2e-3),
        Parameter("K", "N m/A", 0.025, 0.075),
        Parameter("J", "kg m^2", 0.5e-4, 1.5e-4),
        Parameter("b", "N m s/rad", 0.5e-3, 1.5e-3),
    ),
    outputs=(Output("current", "A", 0.02, -5.0, 5.0), Output("speed", "rad/s", 0.5, -100.0, 100.0)),
    states=(5.0, 100.0),
    input="voltage",
    input_unit="V",
    input_limit=12.0,
    sample_time=1e-3,
    horizon=200,
)

TRAINING = PpoConfig(
    total_steps=1_228_800,
    envs=128,
    rollout=PLANT.horizon,
    minibatch=3200,
    learning_rate=2e-3,
    hidden=(32, 32),
    initial_mean=0.3,
    initial_deviation=0.15,
    noise_memory=0.95,
)


def constant(volts: float) -> Control:
    """Control by a constant voltage [V]."""
    return lambda seen: np.full(len(seen), volts)


def main() -> None:
    """Train, compare, export."""
    parser = argparse.ArgumentParser(description="learn to excite a DC motor")
    parser.add_argument("--out", type=Path, default=Path("motor.onnx"), help="the exported actor (%(default)s)")
    parser.add_argument("--steps", type=int, default=TRAINING.total_steps, help="of the training (%(default)s)")
    arguments = parser.parse_args()
    actor = learn(PLANT, replace(TRAINING, total_steps=arguments.steps), seed=0)
    show(f"{'200 motors drawn for this':28}{'ln det gained':>16}{'left the limits':>17}")
    rows = [("trained actor", controlled_by(actor))]
    rows += [(f"constant {u:g} V", constant(u)) for u in (2.0, 3.0, 4.0, 4.5, 5.0, 12.0)]
    for name, control in rows:
        played = play(PLANT, control, count=200, seed=1)
        show(f"{name:28}{played.growth.mean():16.3f}{played.left.sum():13}/200")
    arguments.out.write_bytes(export_actor(PLANT, actor))
    show(f"{arguments.out}: written, with what it is for in its metadata")


if __name__ == "__main__":
    main()
