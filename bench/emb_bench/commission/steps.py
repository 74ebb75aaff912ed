"""Steps of a commissioning: currents within a window, and the policy that sends them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from emb_bench.commission.records import FirstMove
from emb_bench.config.bench import Bench
from emb_bench.export.policy_file import model_of, policy_file
from emb_runtime.policy.contract import SAMPLE

LISTENING = 4.0  # Time to listen [s]: more samples than an experiment has, whose residuals also tell the noise
SHORT = 0.2  # Duration of the runs that move nothing [s]
BELOW = 0.5  # Current of the check of the current, as a share of the least that could move any brake of the data sheet
FIRST_MOVE = 1.3  # Largest current of the first move, in multiples of the one that moves every brake of the data sheet
MOVES = 1.3  # Current of the free stroke, in multiples of the one that moved this brake
REACH = 0.7  # Share of the upper angle limit that an experiment goes to
FASTEST = 0.8  # Share of the speed limit that an experiment goes to
SIGNS = (1, -1, 1, 1, -1, -1, 1, -1, -1, 1)  # of the check of the current, five samples each
SHARES = ((1.0, 0.12), (-1.0, 0.12), (0.7, 0.1), (-0.7, 0.1), (1.0, 0.08), (0.5, 0.06), (-1.0, 0.14))
"""Currents of an experiment, out and back, as shares of its limit, and the share of its samples for each."""


class Window(NamedTuple):
    """Window of a step: outside of it no current flows that drives the brake farther out."""

    lowest: float  # Angle [rad]
    highest: float  # Angle [rad]
    speed: float  # [rad/s]


EVERYWHERE = Window(-math.inf, math.inf, math.inf)


@dataclass(frozen=True)
class Step:
    """One guarded run: its currents and its limits."""

    purpose: str  # Description for the operator
    duration: float  # [s]
    stage: tuple[str, ...]  # Options of ``emb-run`` for the currents that may be sent
    window: Window = EVERYWHERE
    currents: tuple[float, ...] = (0.0,)  # Requested current by sample [A]; after the last one it stays


LISTEN = Step("listen, send nothing", LISTENING, ("--read-only",))
ZERO = Step("the whole chain with 0 A", SHORT, ("--zero",))


def break_away(bench: Bench) -> tuple[float, float]:
    """Least and greatest current that moves some brake of a bench's set from the origin [A]."""
    box = bench.range_set(bench.shield.ranges)
    return box.low.T_c / box.high.k_m, bench.shield.break_away * box.high.T_c / box.low.k_m


def current_check(work: Bench) -> Step:
    """Currents of either sign that move no brake of the data sheet."""
    amplitude = BELOW * break_away(work)[0]
    return Step(
        f"sign, scale and latency of the current with {1e3 * amplitude:.0f} mA, which moves no brake of the data sheet",
        SHORT,
        ("--limit", repr(amplitude)),  # no way home before sign and scale of the current are checked
        Window(-work.shield.home_angle, work.shield.home_angle, work.shield.home_velocity),
        4 * tuple(amplitude * sign for sign in SIGNS for _ in range(5)),
    )


def first_move(work: Bench) -> Step:
    """A current that moves every brake of the data sheet, in either direction."""
    most = min(FIRST_MOVE * break_away(work)[1], work.limits.current)
    fifth = work.timing.horizon // 5
    ramp = [most * (k + 1) / fifth for k in range(fifth)]
    return Step(
        f"a current that rises to {most:.2f} A at most until the brake moves, in either direction",
        work.timing.duration,
        ("--limit", repr(most), "--home"),
        Window(-1.0, 1.0, 10.0),
        (*ramp, *[0.0] * (fifth // 5), *[-value for value in ramp], 0.0),
    )


class Experiment(NamedTuple):
    """An experiment that goes no farther than the bench's limits allow."""

    words: str  # What it is, for the operator
    multiple: float  # Current, in multiples of that of the free stroke
    speed: float  # Largest [rad/s]
    stroke: float  # Share of the free stroke, on the side away from the pads
    highest: float  # Angle [rad]


EXPERIMENTS: Mapping[str, Experiment] = {
    "5-free-stroke": Experiment("the free stroke and the contact", 1.0, 30.0, 0.4, 5.0),
    "6-small": Experiment("a small experiment", 2.0, 80.0, 0.6, 12.0),
    "7-medium": Experiment("a medium experiment", 3.5, 200.0, 0.7, 30.0),
    "8-large": Experiment("a large experiment", math.inf, math.inf, 0.7, math.inf),
}
"""Experiments with the data sheet's ranges, each larger than the one before."""
FULL = Experiment("an experiment with the new bench file", math.inf, math.inf, 0.7, math.inf)


def experiment(row: Experiment, bench: Bench, move: FirstMove) -> Step:
    """An experiment in multiples of the currents of the first move: out and back, as :data:`SHARES` has them."""
    limits, timing = bench.limits, bench.timing
    limit = min(row.multiple * MOVES * max(move.up, move.down), limits.current)
    window = Window(
        row.stroke * limits.angle[0],
        min(row.highest, REACH * limits.angle[1]),
        min(row.speed, FASTEST * limits.velocity),
    )
    currents = (*(limit * share for share, part in SHARES for _ in range(round(part * timing.horizon))), 0.0)
    purpose = f"{row.words}: {limit:.2f} A, {window.lowest:.1f} to {window.highest:.1f} rad, {window.speed:g} rad/s"
    return Step(purpose, timing.duration, ("--limit", repr(limit), "--home"), window, currents)


# --- their policies -------------------------------------------------------------------------------------------------


GRAPH = """commissioning (float[1, 3] inputs) => (float[1, 1] outputs) {
  angle, velocity, time = Split <axis = 1, num_outputs = 3> (inputs)
  step = Mul (time, rate)
  rounded = Round (step)
  number = Cast <to = 7> (rounded)
  place = Min (number, last)
  current = Gather <axis = 0> (currents, place)
  above = Greater (angle, highest)
  fast_up = Greater (velocity, speed)
  no_more_up = Or (above, fast_up)
  upper = Where (no_more_up, zero, most)
  below = Less (angle, lowest)
  slowest = Neg (speed)
  fast_down = Less (velocity, slowest)
  no_more_down = Or (below, fast_down)
  least = Neg (most)
  lower = Where (no_more_down, zero, least)
  raised = Max (current, lower)
  outputs = Min (raised, upper)
}
"""
"""The current of the step, cut to zero on the side that leads out of the window."""


def step_policy(step: Step, bench: Bench) -> bytes:
    """The policy of a step, for a bench: its current, but none that drives the brake farther out of the window."""
    currents, t_s = np.array(step.currents), bench.timing.sample_time
    numbers = {**step.window._asdict(), "rate": 1.0 / t_s, "zero": 0.0, "most": bench.limits.current}
    constants = {name: np.array([value], np.float32) for name, value in numbers.items()}
    constants |= {"last": np.array(len(currents) - 1), "currents": currents.astype(np.float32)}
    seen = np.zeros((len(currents), len(SAMPLE)))
    seen[:, 2] = t_s * np.arange(len(currents))
    provenance = {"commissioning": step.purpose}
    model = model_of(GRAPH, constants)
    return policy_file(model, bench, seen, currents[:, None], provenance, kind="current", inputs=SAMPLE)
