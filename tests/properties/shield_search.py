"""The search that tries to break the envelope shield: adversarial episodes in one compiled loop.

Everything random is drawn beforehand (what the policy wants, noise, lost commands, frame ages); the compiled loop only
adds what depends on the state. Three brakes are driven: the thesis's (forward Euler, 1 ms), the bench's plants, and one
written here, in 25 µs pieces of constant acceleration with an exact standstill, that shares no line with the shield or
with the project's own brakes. ``test_shield_envelope.py`` runs some thousands of them, ``tests/searches/shield.py``
as many as it is told. One file, as only functions of one module are compiled together.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.brake.euler import step as euler_step
from emb_bench.brake.motion import SENSITIVE, STATES, advance
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_bench.config.plants import Mechanics
from emb_runtime.config.bench import BrakeParameters, Ranges, Sensors
from emb_runtime.safety.shield import NO_PAST, PAST, shield
from emb_runtime.safety.shield_design import ShieldLaw, make_law
from tests.benches import SENSOR_BENCH

Floats = NDArray[np.float64]
Codes = NDArray[np.int64]
Generator = np.random.Generator

PIECE = 25e-6  # s, of the fine brake
TAIL = 400  # periods after the experiment, in which a killed run comes to rest
CHUNK = 2000  # episodes drawn at once

# How what is wanted depends on the state.
AS_PLANNED, ONWARD, REVERSE_WHEN_LIMITED, CREEP = range(4)
# What happens to a command.
OBEYED, LOST, LOST_IF_LIMITED, LOST_IF_SLOW_OUTWARD = range(4)
# What the node does in a period without an answer: damped with the speed at the period's begin, damped with the speed
# of each piece (fine brake only), or no current.
DAMPED, DAMPED_WITHIN, FREEWHEEL = range(3)
# Which brake it is: the thesis's, the fine one of this file, or one of the bench's plants.
EULER, FINE, PLANT = range(3)
# Columns of a result row.
LOWEST, HIGHEST, FASTEST, SLOWEST, END_ANGLE, END_VELOCITY, CRUISE_OUT, CRUISE_HOME, LAST_SPEED = range(9)


ROUGH: dict[str, Any] = {"current_lag": 0.002, "break_away": 1.2, "f_l": 1e-6}
COASTING: dict[str, Any] = {"envelope": "coasting", "angle_margin": 1.1}
EXTENSIONS: dict[str, dict[str, Any]] = {
    "break_away 1.2, f_l 2e-6 m": {"break_away": 1.2, "f_l": 2e-6},
    "current_lag 0.5 ms": {"current_lag": 0.0005},
    "current_lag 2 ms": {"current_lag": 0.002},
    "current_lag 2 ms, break_away, f_l": ROUGH,
    "frame ages 0..1": {"frame_age": (0, 1)},
    "frame ages 0..3": {"frame_age": (0, 3)},
    "frame ages 3..3": {"frame_age": (3, 3)},
    "frame ages 0..5": {"frame_age": (0, 5)},
    "frame ages 5..5": {"frame_age": (5, 5)},
    "coasting": COASTING,
    "observer 1520 rad/s": {"observer": 1520.0},
    "observer 800 rad/s": {"observer": 800.0},
    "observer 1520 rad/s, frame ages 0..1": {"observer": 1520.0, "frame_age": (0, 1)},
}
"""What a bench may declare for its shield beyond the thesis's brake."""
PLANTS: dict[str, dict[str, Any]] = {
    "stribeck": {"break_away": 1.2},
    "load": {"break_away": 1.2, "f_l": 2e-6},
    "lag": {"current_lag": 0.002},
    "rough": ROUGH,
    "cubic": {},
    "hysteresis": {},
}
"""Plants of the bench, and what its shield must declare to cover them."""


def bench_with(**declared: Any) -> Bench:
    """The shipped bench with other settings of its shield, and a sensor or an ``observer`` of a bandwidth [rad/s]."""
    bench = SENSOR_BENCH
    if bandwidth := declared.pop("observer", None):
        bench = replace(bench, sensors=Sensors("observer", bandwidth))
    return replace(bench, shield=bench.shield._replace(**declared))


# --- What is wanted: (episodes, samples) in shares of the current limit -------------------------------------------


def _signs(rng: Generator, m: int) -> Floats:
    return np.where(rng.random((m, 1)) < 0.6, 1.0, -1.0)


def _switching(rng: Generator, m: int, n: int) -> NDArray[np.bool_]:
    return rng.random((m, n)) < 1.0 / (1.0 + rng.exponential(25.0, (m, 1)))


def constant(rng: Generator, m: int, n: int) -> Floats:
    return np.repeat(_signs(rng, m), n, axis=1)


def nothing(rng: Generator, m: int, n: int) -> Floats:
    return np.zeros((m, n))


def white(rng: Generator, m: int, n: int) -> Floats:
    return rng.uniform(-1.0, 1.0, (m, n))


def bang_bang(rng: Generator, m: int, n: int) -> Floats:
    return _signs(rng, m) * np.where(np.cumsum(_switching(rng, m, n), axis=1) % 2 == 0, 1.0, -1.0)


def levels(rng: Generator, m: int, n: int) -> Floats:
    last_switch = np.maximum.accumulate(np.where(_switching(rng, m, n), np.arange(n), 0), axis=1)
    return np.take_along_axis(white(rng, m, n), last_switch, axis=1)


def chatter(rng: Generator, m: int, n: int) -> Floats:
    start = rng.integers(0, n // 4, (m, 1))
    return np.where(np.arange(n) < start, _signs(rng, m), np.where(np.arange(n) % 2 == 0, 1.0, -1.0))


def far_then_reverse(rng: Generator, m: int, n: int) -> Floats:
    return np.where(np.arange(n) < rng.integers(0, 500, (m, 1)), 1.0, -1.0)


def periodic(rng: Generator, m: int, n: int) -> Floats:
    period = 2.0 + rng.exponential(100.0, (m, 1))
    wave = np.sin(2.0 * np.pi * (np.arange(n) / period + rng.random((m, 1))))
    return np.where(rng.random((m, 1)) < 0.5, wave, np.sign(wave))


def not_numbers(rng: Generator, m: int, n: int) -> Floats:
    bad = rng.choice([np.nan, np.inf, -np.inf, 1e300, -1e300], (m, n))
    return np.where(rng.random((m, n)) < 0.4, bad, bang_bang(rng, m, n))


def wait_then_push(rng: Generator, m: int, n: int) -> Floats:
    return np.where(np.arange(n) < rng.integers(0, 300, (m, 1)), 0.0, _signs(rng, m))


def few_reversals(rng: Generator, m: int, n: int) -> Floats:
    """Mostly +1, with a −1 that turns the motion around now and then."""
    return np.where(rng.random((m, n)) < 2.0 / n, -1.0, 1.0)


Plan = Callable[[Generator, int, int], Floats]
POLICIES: dict[str, tuple[Plan, int]] = {
    "constant": (constant, AS_PLANNED),
    "nothing": (nothing, AS_PLANNED),
    "white": (white, AS_PLANNED),
    "bang-bang": (bang_bang, AS_PLANNED),
    "levels": (levels, AS_PLANNED),
    "chatter": (chatter, AS_PLANNED),
    "far then reverse": (far_then_reverse, AS_PLANNED),
    "periodic": (periodic, AS_PLANNED),
    "not numbers": (not_numbers, AS_PLANNED),
    "wait then push": (wait_then_push, AS_PLANNED),
    "onward to the nearest limit": (few_reversals, ONWARD),
    "reverse when limited": (constant, REVERSE_WHEN_LIMITED),
    "creep along a limit": (constant, CREEP),
}


# --- Noise: (episodes, samples, 2) in shares of what the shield must expect ------------------------------------------


# The number says whether the noise follows the velocity: the brake then looks faster (+1) or slower (−1) than it is.
NOISES: dict[str, tuple[Plan, int]] = {
    "none": (lambda _rng, m, n: np.zeros((m, n, 2)), 0),
    "Gaussian": (lambda rng, m, n: np.clip(rng.normal(0.0, 1.0 / 6.0, (m, n, 2)), -1.0, 1.0), 0),
    "uniform": (lambda rng, m, n: rng.uniform(-1.0, 1.0, (m, n, 2)), 0),
    "coin flips": (lambda rng, m, n: rng.choice([-1.0, 1.0], (m, n, 2)), 0),
    "biased": (lambda rng, m, n: np.repeat(rng.choice([-1.0, 1.0], (m, 1, 2)), n, axis=1), 0),
    "looks faster": (lambda _rng, m, n: np.ones((m, n, 2)), 1),
    "looks slower": (lambda _rng, m, n: np.ones((m, n, 2)), -1),
}


# --- Lost commands: (episodes, samples) codes ------------------------------------------------------------------------


def _bursts(rng: Generator, m: int, n: int) -> Codes:
    since = np.arange(n) - np.maximum.accumulate(np.where(rng.random((m, n)) < 0.03, np.arange(n), -1000), axis=1)
    return np.where(since < rng.integers(1, 12, (m, 1)), LOST, OBEYED)


def _pairs(rng: Generator, m: int, n: int) -> Codes:
    """Two in a row, time and again."""
    first = rng.random((m, n)) < 0.05
    return np.where(first | np.roll(first, 1, axis=1), LOST, OBEYED)


DROPS: dict[str, Callable[[Generator, int, int], Codes]] = {
    "none": lambda _rng, m, n: np.full((m, n), OBEYED),
    "some": lambda rng, m, n: np.where(rng.random((m, n)) < 0.1, LOST, OBEYED),
    "pairs": _pairs,
    "bursts": _bursts,
    "when limited": lambda rng, m, n: np.where(rng.random((m, n)) < 0.5, LOST_IF_LIMITED, OBEYED),
    "every other": lambda _rng, m, n: np.tile(np.where(np.arange(n) % 2 == 1, LOST, OBEYED), (m, 1)),
    "slow outward": lambda _rng, m, n: np.full((m, n), LOST_IF_SLOW_OUTWARD),
    "killed": lambda rng, m, n: np.where(np.arange(n) < rng.integers(0, 500, (m, 1)), OBEYED, LOST),
}


# --- The two brakes and the node's stop -----------------------------------------------------------------------------


class Features(NamedTuple):
    """What a brake has beyond the thesis's: as in ``emb_bench.config.plants.Mechanics``."""

    current_lag: float = 0.0
    break_away: float = 1.0
    stribeck_velocity: float = 0.0
    f_l: float = 0.0
    quadratic: float = 0.0
    cubic: float = 0.0
    hysteresis: float = 0.0


PLAIN = Features()


def fine_piece(p: BrakeParameters, x: float, v: float, u: float, h: float, f: Features = PLAIN) -> tuple[float, float]:
    """The brake over ``h`` seconds at constant driving torque, friction with an exact standstill."""
    force = p.k_1 * x * (1.0 + f.quadratic * x + f.cubic * x * x) if x > 0.0 else 0.0
    if v != 0.0:
        force *= 1.0 + math.copysign(f.hysteresis, v)
    drive = (p.k_m * u - p.gamma * force) / p.J
    static = f.break_away * p.T_c + f.f_l * force
    sliding = p.T_c
    if f.stribeck_velocity > 0.0:
        sliding += (static - p.T_c) * math.exp(-((v / f.stribeck_velocity) ** 2))
    while h > 0.0:
        if v == 0.0:
            if abs(drive) <= static / p.J:
                return x, 0.0
            moving = 1.0 if drive > 0.0 else -1.0
        else:
            moving = 1.0 if v > 0.0 else -1.0
        a = drive - moving * sliding / p.J - p.f_v * v / p.J
        part = h
        if a * moving < 0.0 and v != 0.0 and -v / a < h:
            part = -v / a
        x += (v + 0.5 * a * part) * part
        v = 0.0 if part < h else v + a * part
        h -= part
    return x, v


def damped(law: ShieldLaw, v: float) -> float:
    """The node's damped stop [A]."""
    u = -law.current * v / law.damping_velocity
    return math.copysign(law.current, u) if abs(u) > law.current else u


# --- Episodes -------------------------------------------------------------------------------------------------------


class Script(NamedTuple):
    """What was drawn for a chunk of episodes; the first axis counts them, the second samples."""

    brakes: Floats
    wanted: Floats
    feedback: Codes
    touches: Codes  # Limited commands after which REVERSE_WHEN_LIMITED reverses
    errors: Floats
    follows: Codes
    drops: Codes
    ages: Codes
    solvers: Codes
    features: Floats  # One row of :class:`Features` per episode, for the fine brake
    plant: Mechanics  # For the project's own
    stop: Codes
    observers: Floats  # Bandwidth [rad/s], 0 for a sensor; damping; 1 if sampled with the brake, 0 continuously


def observe(o: Floats, tracked: Floats, angle: float, h: float) -> None:
    """A tracking loop of second order after one more angle, in place: ``tracked`` is its angle and velocity.

    With the poles of a continuous one. In the pieces of the fine brake it is as good as that.
    """
    radius = math.exp(-o[1] * o[0] * h)
    real = radius * math.cos(math.sqrt(1.0 - o[1] * o[1]) * o[0] * h)
    ahead = tracked[0] + h * tracked[1]
    tracked[0] = ahead + (1.0 - radius * radius) * (angle - ahead)
    tracked[1] += (1.0 + radius * radius - 2.0 * real) / h * (angle - ahead)


def _wanted(feedback: int, planned: float, v: float, limit: float) -> float:
    if feedback == ONWARD and v != 0.0:
        return math.copysign(limit, v) * planned
    if feedback == CREEP and v * planned > 40.0:
        return -limit * planned
    return limit * planned


def _is_lost(code: int, bits: int, x: float, v: float) -> bool:
    if code == LOST_IF_LIMITED:
        return bits != 0
    if code == LOST_IF_SLOW_OUTWARD:
        return 0.0 < v < 65.0 if x > 20.0 else (x < -2.0 and -65.0 < v < 0.0)
    return code == LOST


def _drive(
    law: ShieldLaw,
    plant: Mechanics,
    f: Features,
    p: BrakeParameters,
    state: Floats,
    u: float,
    solver: int,
    within: bool,
    row: Floats,
    observer: Floats,
    tracked: Floats,
) -> None:
    """One period of the true brake, in place; its extremes go into ``row``, its angles to a continuous observer."""
    for _ in range(round(law.sample_time / PIECE) if solver == FINE else 1):
        x, v = float(state[0]), float(state[1])
        if solver == EULER:
            x, v = euler_step(p, x, v, u, law.sample_time)
        elif solver == FINE:
            if within:
                u = damped(law, v)
            state[3] = u if f.current_lag == 0.0 else u + (state[3] - u) * math.exp(-PIECE / f.current_lag)
            x, v = fine_piece(p, x, v, float(state[3]), PIECE, f)
        else:
            advance(plant, p, state, u, law.sample_time, np.zeros(0, np.int64), np.zeros((0, SENSITIVE)))
            x, v = float(state[0]), float(state[1])
        state[0], state[1] = x, v
        if observer[0] > 0.0 and observer[2] == 0.0:
            observe(observer, tracked, x, PIECE)
        row[LOWEST] = min(row[LOWEST], x)
        row[HIGHEST] = max(row[HIGHEST], x)
        row[FASTEST] = max(row[FASTEST], v)
        row[SLOWEST] = min(row[SLOWEST], v)


def _note_cruise(x: float, v: float, row: Floats, counts: Floats) -> None:
    if 20.0 < x < 60.0 and abs(v) > 200.0:
        i = 0 if v > 0.0 else 1
        counts[i] += 1.0
        row[CRUISE_OUT + i] += (abs(v) - row[CRUISE_OUT + i]) / counts[i]


def episode(law: ShieldLaw, script: Script, i: int, row: Floats) -> None:
    """Run one episode and write its extremes into ``row``."""
    b = script.brakes[i]
    p = BrakeParameters(b[0], b[1], b[2], b[3], b[4], b[5])
    s = script.features[i]
    f = Features(s[0], s[1], s[2], s[3], s[4], s[5], s[6])
    angles = np.zeros(PAST + 1)  # the true states, newest first
    velocities = np.zeros(PAST + 1)
    shown = np.zeros(PAST + 1)  # velocities that are measured, without noise
    tracked = np.zeros(2)
    counts = np.zeros(2)
    state = np.zeros(STATES)
    x = v = 0.0
    past = NO_PAST
    bits = touched = 0
    turn = 1.0
    for k in range(script.wanted.shape[1]):
        angles[1:] = angles[:-1].copy()
        velocities[1:] = velocities[:-1].copy()
        shown[1:] = shown[:-1].copy()
        angles[0], velocities[0], shown[0] = x, v, v
        if script.observers[i, 0] > 0.0:
            if script.observers[i, 2] > 0.0 and k > 0:
                observe(script.observers[i], tracked, x, law.sample_time)
            shown[0] = tracked[1]
        if script.feedback[i] == REVERSE_WHEN_LIMITED and bits & 2:
            touched += 1
            if touched % script.touches[i] == 0:
                turn = -turn
        age = script.ages[i, k]
        side = 1.0 if script.follows[i] == 0 else script.follows[i] * math.copysign(1.0, velocities[age])
        u, bits = shield(
            law,
            angles[age] + side * script.errors[i, k, 0] * law.angle_noise,
            shown[age] + side * script.errors[i, k, 1] * law.velocity_noise,
            turn * _wanted(script.feedback[i], script.wanted[i, k], v, law.current),
            past,
            k,
        )
        past = (u, past[0], past[1], past[2], past[3])
        lost = _is_lost(script.drops[i, k], bits, x, v)
        if lost:
            u = 0.0 if script.stop[i] == FREEWHEEL else damped(law, v)
        within = lost and script.stop[i] == DAMPED_WITHIN
        _drive(law, script.plant, f, p, state, u, script.solvers[i], within, row, script.observers[i], tracked)
        x, v = float(state[0]), float(state[1])
        row[LAST_SPEED] = abs(v)
        if k == law.steps - 1:
            row[END_ANGLE] = x
            row[END_VELOCITY] = v
        if k < law.steps:
            _note_cruise(x, v, row, counts)
        if script.stop[i] == FREEWHEEL and not -10.0 <= x <= 100.0 and not law.coasting:
            return  # it has hit the end stop with this speed


def episodes(law: ShieldLaw, script: Script, rows: Floats) -> None:
    """Run one episode per row."""
    for i in range(rows.shape[0]):
        episode(law, script, i, rows[i])


class Found(NamedTuple):
    """What a search found; the first axis of each array counts its episodes."""

    bench: Bench
    seed: int
    brakes: Floats
    labels: Codes  # Indices of policy, noise, drops, and solver
    rows: Floats

    @property
    def violated(self) -> NDArray[np.bool_]:
        """Episodes that left a limit (NaN counts)."""
        r, limits = self.rows, self.bench.limits
        low = np.array([limits.angle[0], limits.angle[0], -limits.velocity, -limits.velocity])
        high = np.array([limits.angle[1], limits.angle[1], limits.velocity, limits.velocity])
        extremes = r[:, [LOWEST, HIGHEST, SLOWEST, FASTEST]]
        outside: NDArray[np.bool_] = np.any(~((extremes >= low) & (extremes <= high)), axis=1)
        return outside

    @property
    def home(self) -> NDArray[np.bool_]:
        """Episodes that ended at home."""
        home = np.array([self.bench.shield.home_angle, self.bench.shield.home_velocity])
        at_home: NDArray[np.bool_] = np.all(np.abs(self.rows[:, [END_ANGLE, END_VELOCITY]]) <= home, axis=1)
        return at_home

    @property
    def obeyed(self) -> NDArray[np.bool_]:
        """Episodes in which no command was lost."""
        return self.of("none")

    def of(self, drops: str) -> NDArray[np.bool_]:
        """Episodes with that kind of lost commands."""
        return np.equal(self.labels[:, 2], list(DROPS).index(drops))

    def describe(self, i: int) -> str:
        """One episode in words."""
        policy, noise, drops, solver = self.labels[i]
        r = self.rows[i]
        return (
            f"episode {i} of seed {self.seed}: {', '.join(f'{b:.6g}' for b in self.brakes[i])}; "
            f"{list(POLICIES)[policy]}; noise {list(NOISES)[noise]}; lost {list(DROPS)[drops]}; "
            f"{('Euler', 'fine', 'plant')[solver]}; angle {r[LOWEST]:.3f}..{r[HIGHEST]:.3f} rad, velocity "
            f"{r[SLOWEST]:.1f}..{r[FASTEST]:.1f} rad/s, end {r[END_ANGLE]:.3f} rad {r[END_VELOCITY]:.2f} rad/s"
        )


def draw_brakes(rng: Generator, box: Ranges, n: int) -> Floats:
    """Half corners, half interior."""
    low, high = np.array(box.low), np.array(box.high)
    share = rng.random((n, len(low)))
    corner = rng.random(n) < 0.5
    share[corner] = np.round(share[corner])
    brakes: Floats = low + share * (high - low)
    return brakes


def _kinds(
    rng: Generator, n: int, table: dict[str, tuple[Plan, int]], samples: int, out: Floats
) -> tuple[Codes, Codes]:
    """Fill ``out`` from randomly chosen entries; their indices and their numbers."""
    chosen = rng.integers(0, len(table), n)
    numbers = np.zeros(n, dtype=np.int64)
    for j, (draw, number) in enumerate(table.values()):
        where = np.flatnonzero(chosen == j)
        out[where] = draw(rng, len(where), samples)
        numbers[where] = number
    return chosen, numbers


def draw_features(rng: Generator, bench: Bench, n: int) -> Floats:
    """What the shield of this bench allows a brake to have: half of them all of it."""
    s = bench.shield
    share = np.where(rng.random((n, 1)) < 0.5, 1.0, rng.random((n, 7)))
    most = np.array([s.current_lag, s.break_away - 1.0, 0.0, s.f_l, 0.0, 0.0, 0.0])
    features: Floats = share * most + np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    features[:, 2] = rng.choice([0.0, 10.0, 30.0, 200.0], n)
    return features


def draw_observers(rng: Generator, bandwidth: float, solvers: Codes) -> Floats:
    """Observers of at least this bandwidth, with a damping from 0.7 to 1; half of them have just that.

    Sampled or, of the fine brake, as good as continuous. Euler's angles are half a period late: its velocity is shown.
    """
    n = len(solvers)
    observers = np.zeros((n, 3))
    seen = solvers != EULER
    observers[:, 0] = np.where(seen, bandwidth * rng.choice([1.0, 1.0, 2.0, 20.0], n), 0.0)
    observers[:, 1] = rng.choice([0.7, 0.85, 1.0, 1.0], n)
    observers[:, 2] = np.where(solvers == FINE, rng.integers(0, 2, n), 1.0)
    return observers


def of_plant(mechanics: Mechanics) -> Features:
    """The features of one of the bench's plants."""
    return Features(*(getattr(mechanics, name) for name in Features._fields))


def within_stiffness(box: Ranges, f: Features, farthest: float) -> Ranges:
    """The part of a set whose brakes have F_cl / x within the set's k_1 up to the farthest angle."""
    stiffest = (1.0 + f.quadratic * farthest + f.cubic * farthest * farthest) * (1.0 + f.hysteresis)
    return replace(
        box,
        low=box.low._replace(k_1=box.low.k_1 / (1.0 - f.hysteresis)),
        high=box.high._replace(k_1=box.high.k_1 / stiffest),
    )


def search(
    bench: Bench,
    n: int,
    seed: int,
    *,
    truth: str | None = None,
    law: ShieldLaw | None = None,
    ages: tuple[int, int] | None = None,
    drops: tuple[str, ...] = tuple(DROPS),
    freewheel: bool = False,
    plant: str | None = None,
    bandwidth: float | None = None,
) -> Found:
    """Run ``n`` random adversarial episodes against the shield of a bench.

    Args:
        bench: its shield is made, its limits are checked.
        n: episodes.
        seed: of everything.
        truth: set that the true brakes come from; without it the set that the shield was made for.
        law: to be tested in place of the bench's own.
        ages: true frame ages; without it those that the shield was made for.
        drops: kinds of lost commands, half of the episodes have none.
        freewheel: the node switches the current off in place of the damped stop.
        plant: the bench's plant whose features the brakes have, half of them by the project's own solver; without it
            Euler's brake and the fine one, with what the shield allows.
        bandwidth: of the true observers, at least [rad/s]; without it the one that the bench declares, or no observer.
    """
    law = law or make_law(bench)
    youngest, oldest = ages or (law.age_low, law.age_high)
    rng = np.random.default_rng(seed)
    bandwidth = bandwidth or bench.sensors.observer_bandwidth or 0.0
    box = bench.range_set(truth or bench.shield.ranges)
    mechanics = bench.plant(plant or "exact").mechanics
    features = np.tile(np.array(of_plant(mechanics)), (n, 1))
    if plant is None:
        features = draw_features(rng, bench, n)
    else:
        box = within_stiffness(box, of_plant(mechanics), bench.limits.angle[1])
    brakes = draw_brakes(rng, box, n)
    labels = np.zeros((n, 4), dtype=np.int64)
    rows = np.zeros((n, 9))
    for first in range(0, n, CHUNK):
        part = slice(first, min(first + CHUNK, n))
        m = part.stop - part.start
        kind = np.array([list(DROPS).index(d) for d in drops])[rng.integers(0, len(drops), m)]
        kind[rng.random(m) < 0.5 if len(drops) > 1 else np.zeros(m, dtype=bool)] = 0
        samples = law.steps + (TAIL if list(DROPS).index("killed") in kind else 0)
        wanted, errors = np.zeros((m, samples)), np.zeros((m, samples, 2))
        lost = np.zeros((m, samples), dtype=np.int64)
        for j, draw in enumerate(DROPS.values()):
            lost[kind == j] = draw(rng, int(np.sum(kind == j)), samples)
        policy, feedback = _kinds(rng, m, POLICIES, samples, wanted)
        noise, follows = _kinds(rng, m, NOISES, samples, errors)
        late = np.sort(rng.integers(youngest, oldest + 1, (m, 2)), axis=1)
        solvers = rng.integers(0, 2, m) if plant is None else rng.integers(FINE, PLANT + 1, m)
        script = Script(
            brakes=brakes[part],
            wanted=wanted,
            feedback=feedback,
            touches=rng.integers(1, 60, m),
            errors=errors,
            follows=follows,
            drops=lost,
            ages=rng.integers(late[:, :1], late[:, 1:] + 1, (m, samples)),
            solvers=solvers,
            features=features[part],
            plant=mechanics,
            stop=np.full(m, FREEWHEEL) if freewheel else rng.integers(0, 2, m),
            observers=draw_observers(rng, bandwidth, solvers) if bandwidth else np.zeros((m, 3)),
        )
        labels[part] = np.stack([policy, noise, kind, solvers], axis=1)
        compiled(episodes)(law, script, rows[part])
    return Found(bench, seed, brakes, labels, rows)
