"""Records of brakes with any of the features, from a simulator that shares no code with the estimators.

Steps of at most 20 µs of the classical Runge-Kutta method, whose step ends where the brake stops; a friction, a
clearance, an observer and a quantisation of its own. What the bench's plant ``euler`` does is defined by its
steps of a whole period, which are written down here once more from the equations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from emb_bench.config.plants import EULER, Plant
from emb_bench.experiment.experiment import Experiment
from emb_runtime.config.bench import PARAMETER_NAMES, Bench

Floats = NDArray[np.float64]

STEP = 2e-5  # Longest step of the simulation [s]
AT_REST = 50  # Samples before the experiment
ANGLE_STEP, VELOCITY_STEP = 1e-4, 0.01  # Quantisation of what is sent [rad] and [rad/s]
KICKS = 10  # Steps of a random walk in a period
ORIGIN_SIGMAS = 4.0  # A mean at rest that lies this near to the origin counts as there


@dataclass(frozen=True)
class Brake:
    """A brake with its features, and its sensors with their errors."""

    k_m: float
    k_1: float
    t_c: float
    f_v: float
    inertia: float
    gamma: float
    encoder_offset: float = 0.0
    current_offset: float = 0.0
    delay: float = 0.0  # By which a command acts late [periods], below 1
    velocity_gain: float = 0.0
    quadratic: float = 0.0
    cubic: float = 0.0
    play: float = 0.0  # Clearance between the motor and the clamp [rad]
    stribeck: float = 0.0  # Share of the static friction beyond T_c, without load
    hysteresis: float = 0.0
    current_lag: float = 0.0
    asymmetry: float = 0.0  # Share by which the friction of the positive direction is larger, that of the other smaller
    stribeck_velocity: float = 30.0
    f_l: float = 0.0
    hysteresis_travel: float = 1.0
    k_m_drift: float = 0.0
    """Share by which k_m has changed at the end of the experiment, linearly with time; the next three likewise."""
    k_1_drift: float = 0.0
    t_c_drift: float = 0.0
    f_v_drift: float = 0.0
    stepped: bool = False  # By whole periods, with sign()
    measurement_delay: int = 0
    clock_jitter: float = 0.0
    observer_bandwidth: float = 0.0
    velocity_walk: float = 0.0
    """Standard deviation of a random walk of the velocity, which a white torque makes [rad/s per √s]."""
    torque_walk: float = 0.0  # Standard deviation of a random walk of the load [N·m per √s]
    encoder_step: float = 0.0
    """Step of the angle that an encoder shows, its noise before the rounding; an observer sees it too [rad]."""
    angle_scale: float = 0.0  # Relative error of the angle's scale
    ripple: float = 0.0  # Torque over the angle, as a share of T_c
    ripple_period: float = 2.0 * math.pi  # Of the torque, and of the stiffness [rad]
    stiffness_ripple: float = 0.0  # Periodic share of the clamping force
    current_gain: float = 0.0  # Share by which k_m is larger at 6 A, linearly with the size of the current
    dead_current: float = 0.0  # Current below which none acts [A]
    drag: float = 0.0  # Share by which f_v is larger at 500 rad/s, linearly with the speed
    thinning: float = 0.0  # Power of 250 rad/s over the speed by which f_v is larger
    f_v_asymmetry: float = 0.0  # Share by which f_v is larger in the positive direction, smaller in the other
    load_friction: float = 0.0  # Friction that grows with the load at any speed [m]
    place_friction: float = 0.0  # Share by which T_c is larger at 100 rad, linearly with the angle
    t_c_settling: float = 0.0  # Share by which T_c is larger at the start; it decays in 0.1 s
    k_m_settling: float = 0.0
    offset_drift: float = 0.0  # Change of the current's offset to the end of the experiment [A]
    eccentricity: float = 0.0  # Periodic error of the encoder [rad]
    velocity_asymmetry: float = 0.0  # Share by which the velocity is shown too large in the positive direction
    velocity_lag: float = 0.0  # Of the velocity that is shown [s]
    clock_scale: float = 0.0  # Share by which a period is longer than it is said to be
    bent: float = 0.0  # Torque that changes with the place, the velocity, ... by a form: one of ``TORQUES``
    along: float = 0.0  # What it changes with: one of ``ALONG``
    form: tuple[float, ...] = (0.0, 0.0)
    """Share by which it is larger, at even distances from -1 to 1 of what it changes with, over ``RANGES``."""

    def numbers(self) -> Floats:
        """All of them in one row, as the integration takes them; the form comes last."""
        scalars = [value for name, value in vars(self).items() if name != "form"]
        return np.array([*scalars, 0.0, *self.form], dtype=np.float64)


# Places in ``Brake.numbers``.
_KM, _K1, _TC, _FV, _J, _GAMMA, _, _BIAS, _, _, _QUAD, _CUBE, _PLAY, _STRIBECK, _HYST, _LAG, _ASYM = range(17)
_VS, _FL, _TRAVEL, _KM_DRIFT, _K1_DRIFT, _TC_DRIFT, _FV_DRIFT = range(17, 24)
_RIPPLE, _PERIOD, _K1_RIPPLE, _GAIN, _DEAD, _DRAG, _THIN, _FV_ASYM, _MU, _PLACE = range(32, 42)
TORQUES = "none", "k_m", "k_1", "T_c", "f_v"
ALONG = "none", "place", "speed", "velocity", "load", "current", "time"
RANGES = 1.0, 100.0, 500.0, 500.0, 100.0, 6.0, 1.0
"""Of them: angle and travel of the clamp [rad], velocity [rad/s], current [A], the whole record."""
_BENT, _ALONG, _NOW, _FORM = 49, 50, 51, 52
SETTLING = 0.1  # Time in which what settles has decayed to 1/e [s]


def brake_of(bench: Bench, plant: Plant, factors: Floats) -> Brake:
    """The brake that a plant of the bench stands for, its four parameters being nominal times ``factors``."""
    p, m, instruments = bench.brake, plant.mechanics, plant.instruments
    k_m, k_1, t_c, f_v = (getattr(p, name) * f for name, f in zip(PARAMETER_NAMES, factors.tolist(), strict=True))
    return Brake(
        k_m,
        k_1,
        t_c,
        f_v,
        p.J,
        p.gamma,
        encoder_offset=instruments.encoder_offset,
        quadratic=m.quadratic,
        cubic=m.cubic,
        stribeck=m.break_away - 1.0,
        stribeck_velocity=m.stribeck_velocity or 1e-9,
        f_l=m.f_l,
        hysteresis=m.hysteresis,
        hysteresis_travel=m.hysteresis_travel,
        play=m.play,
        current_lag=m.current_lag,
        stepped=m.solver == EULER,
        measurement_delay=instruments.measurement_delay,
        clock_jitter=instruments.clock_jitter,
        observer_bandwidth=instruments.observer_bandwidth,
    )


@numba.njit(cache=False)
def _formed(b, torque, x, v, i):  # type: ignore[no-untyped-def]
    """Factor of a torque that changes by the form."""
    if b[_BENT] != torque:
        return 1.0
    along = int(b[_ALONG])
    if along == 1:
        at = x
    elif along == 2:
        at = abs(v)
    elif along == 3:
        at = v
    elif along == 4:
        at = max(x, 0.0)
    elif along == 5:
        at = i
    else:
        at = b[_NOW]
    last = b.shape[0] - _FORM - 1
    place = min(max(0.5 * (at / RANGES[along] + 1.0), 0.0), 1.0) * last
    k = min(int(place), last - 1)
    return 1.0 + b[_FORM + k] + (place - k) * (b[_FORM + k + 1] - b[_FORM + k])


@numba.njit(cache=False)
def _force(b, x, z, w):  # type: ignore[no-untyped-def]
    """Clamping force: of the travel behind the clearance, with a hysteresis."""
    travel = x if b[_PLAY] == 0.0 else z
    if travel <= 0.0:
        return 0.0
    periodic = 1.0 + b[_K1_RIPPLE] * math.sin(2.0 * math.pi * travel / b[_PERIOD])
    k_1 = b[_K1] * _formed(b, 2, travel, 0.0, 0.0)
    return k_1 * travel * (1.0 + b[_QUAD] * travel + b[_CUBE] * travel * travel) * (1.0 + b[_HYST] * w) * periodic


@numba.njit(cache=False)
def _follow(b, x, z, w, moved):  # type: ignore[no-untyped-def]
    """Clearance and hysteresis after the angle has moved."""
    half = 0.5 * b[_PLAY]
    z = min(max(z, x - half), x + half)
    w = 0.0 if x <= 0.0 else min(max(w + min(moved, x) / b[_TRAVEL], -1.0), 1.0)
    return z, w


@numba.njit(cache=False)
def _friction(b, x, v, force, sign):  # type: ignore[no-untyped-def]
    """Friction but the viscous one: Coulomb's, and what is static beyond it as far as it is left at a speed."""
    remaining = math.exp(-((v / b[_VS]) ** 2))
    coulomb = b[_TC] * (1.0 + b[_ASYM] * sign) * (1.0 + 0.01 * b[_PLACE] * x) * _formed(b, 3, x, v, 0.0)
    return coulomb * (1.0 + b[_STRIBECK] * remaining) + (b[_FL] * remaining + b[_MU]) * force


@numba.njit(cache=False)
def _viscous(b, x, v, sign):  # type: ignore[no-untyped-def]
    """Viscous friction [N·m]."""
    size = abs(v)
    thinned = (250.0 / size) ** b[_THIN] if b[_THIN] != 0.0 and size > 0.0 else 1.0
    return (
        b[_FV] * _formed(b, 4, x, v, 0.0) * v * (1.0 + b[_DRAG] * size / 500.0) * (1.0 + b[_FV_ASYM] * sign) * thinned
    )


@numba.njit(cache=False)
def _drive(b, x, v, i):  # type: ignore[no-untyped-def]
    """Torque of the motor [N·m]."""
    if abs(i) < b[_DEAD]:
        i = 0.0
    ripple = b[_RIPPLE] * b[_TC] * math.sin(2.0 * math.pi * x / b[_PERIOD])
    return b[_KM] * _formed(b, 1, x, v, i) * i * (1.0 + b[_GAIN] * abs(i) / 6.0) + ripple


@numba.njit(cache=False)
def _slope(b, x, v, i, z0, w0, x0, sign):  # type: ignore[no-untyped-def]
    z, w = _follow(b, x, z0, w0, x - x0)
    force = _force(b, x, z, w)
    torque = _drive(b, x, v, i) - b[_GAMMA] * force - _viscous(b, x, v, sign) - sign * _friction(b, x, v, force, sign)
    return torque / b[_J]


@numba.njit(cache=False)
def _current(b, i, u, t):  # type: ignore[no-untyped-def]
    return u if b[_LAG] == 0.0 else u + (i - u) * math.exp(-t / b[_LAG])


@numba.njit(cache=False)
def _runge_kutta(b, x, v, i, u, z, w, sign, h):  # type: ignore[no-untyped-def]
    middle, end = _current(b, i, u, 0.5 * h), _current(b, i, u, h)
    a1 = _slope(b, x, v, i, z, w, x, sign)
    x2, v2 = x + 0.5 * h * v, v + 0.5 * h * a1
    a2 = _slope(b, x2, v2, middle, z, w, x, sign)
    x3, v3 = x + 0.5 * h * v2, v + 0.5 * h * a2
    a3 = _slope(b, x3, v3, middle, z, w, x, sign)
    x4, v4 = x + h * v3, v + h * a3
    a4 = _slope(b, x4, v4, end, z, w, x, sign)
    return x + h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4), v + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)


@numba.njit(cache=False)
def _move(b, state, command, duration):  # type: ignore[no-untyped-def]
    """Angle, velocity, current, clearance and hysteresis after a time with one command."""
    x, v, i, z, w = state
    u, remaining = command + b[_BIAS], duration
    if b[_LAG] == 0.0:
        i = u
    while remaining > 1e-15:
        h = min(STEP, remaining)
        if v == 0.0:
            force = _force(b, x, z, w)
            drive = _drive(b, x, 0.0, _current(b, i, u, h)) - b[_GAMMA] * force
            sign = 1.0 if drive > 0.0 else -1.0
            if abs(drive) <= _friction(b, x, 0.0, force, sign):
                i = _current(b, i, u, h)
                remaining -= h
                continue
        else:
            sign = 1.0 if v > 0.0 else -1.0
        x_end, v_end = _runge_kutta(b, x, v, i, u, z, w, sign, h)
        stops = v_end * sign <= 0.0
        if stops and v != 0.0:
            low, high = 0.0, h
            for _ in range(60):
                h = 0.5 * (low + high)
                x_end, v_end = _runge_kutta(b, x, v, i, u, z, w, sign, h)
                if v_end * sign <= 0.0:
                    high = h
                else:
                    low = h
        if stops:
            v_end = 0.0
        z, w = _follow(b, x_end, z, w, x_end - x)
        i = _current(b, i, u, h)
        x, v = x_end, v_end
        remaining -= h
    return x, v, i, z, w


@numba.njit(cache=False)
def _step(b, state, u, t_s):  # type: ignore[no-untyped-def]
    """A whole period at once, with the friction of sign() or with an interval of rest."""
    x, v, _, z, w = state
    clamping = b[_GAMMA] * b[_K1] * x if x >= 0.0 else 0.0
    pull = b[_KM] * u - clamping
    sign = 1.0 if v > 0.0 else -1.0 if v < 0.0 else 0.0
    return x + t_s * v, v + t_s * (pull - sign * b[_TC] - b[_FV] * v) / b[_J], u, z, w


class _Sensors:
    """Sensors: the samples that are sent of a motion, one by one."""

    def __init__(self, brake: Brake, bench: Bench, rng: np.random.Generator) -> None:
        self.brake, self.rng, self.t_s = brake, rng, bench.timing.sample_time
        self.sigma = np.array([bench.noise.angle, bench.noise.velocity])
        self.line = [np.array([brake.encoder_offset, 0.0])] * brake.measurement_delay
        self.tracked = np.array([brake.encoder_offset, 0.0])
        self.lagged = 0.0
        pole = np.exp(complex(-0.7, math.sqrt(1.0 - 0.7**2)) * brake.observer_bandwidth * self.t_s)
        # The poles of the filter that adds (α, β/T) times the surprise to what it tracks.
        self.gains = np.array([1.0 - abs(pole) ** 2, (1.0 + abs(pole) ** 2 - 2.0 * pole.real) / self.t_s])

    def shown(self, x: float, v: float) -> Floats:
        b = self.brake
        remaining = math.exp(-self.t_s / b.velocity_lag) if b.velocity_lag > 0.0 else 0.0
        self.lagged = v + (self.lagged - v) * remaining
        angle = x * (1.0 + b.angle_scale) + b.encoder_offset + b.eccentricity * math.sin(x)
        gain = 1.0 + b.velocity_gain + (b.velocity_asymmetry if v > 0.0 else 0.0)
        true = np.array([angle, self.lagged * gain])
        sample = true + self.sigma * self.rng.standard_normal(2)
        if self.brake.encoder_step > 0.0:
            sample[0] = round(sample[0] / self.brake.encoder_step) * self.brake.encoder_step
        if self.brake.observer_bandwidth > 0.0:
            ahead = self.tracked + np.array([self.t_s * self.tracked[1], 0.0])
            self.tracked = ahead + self.gains * (sample[0] - ahead[0])
            sample[1] = self.tracked[1]
        self.line.append(np.round(sample / [ANGLE_STEP, VELOCITY_STEP]) * [ANGLE_STEP, VELOCITY_STEP])
        return self.line.pop(0)


@dataclass(frozen=True)
class Losses:
    """Samples and commands that do not arrive."""

    samples: NDArray[np.bool_]
    """Samples at the ends of the periods, shape (n,): no command answers them, and the node brakes the next period."""
    commands: NDArray[np.bool_]  # Commands for the periods, shape (n,): the node brakes


def braking(bench: Bench, velocity: float) -> float:
    """Current of the node's own stop: against the speed, in the steps of the bus [A]."""
    most = bench.limits.current
    return round(min(max(-most * velocity / bench.node.damping_velocity, -most), most), 3)


def simulate(
    brake: Brake,
    bench: Bench,
    rng: np.random.Generator,
    name: str,
    losses: Losses | None = None,
    *,
    charge: bool = False,
    planned: Floats | None = None,
) -> Experiment:
    """An experiment: the planned currents [A], or a random excitation that is turned around near the limits.

    Where the report of a period is lost, the record assumes that its command acted, or where none was sent, the node's
    braking from the last velocity that arrived. With ``charge`` the samples on both sides of a single lost one carry
    the integral of the current, whose difference is the sum of two currents, of which the later one is reported.
    """
    n, t_s, b = bench.timing.horizon, bench.timing.sample_time * (1.0 + brake.clock_scale), brake.numbers()
    constant = b[_KM : _FV + 1].copy()
    requested = excitation(rng, n, bench.limits.current) if planned is None else planned
    state, before = (0.0, 0.0, brake.current_offset, 0.0, 0.0), 0.0
    currents, acted, samples = np.empty(n), np.empty(n), np.empty((n, 2))
    sensors = _Sensors(brake, bench, rng)
    rest = np.mean([sensors.shown(0.0, 0.0) for _ in range(AT_REST)], axis=0)
    angle, velocity = rest
    received, assumed = True, np.full(n, np.nan)
    lowest, highest = bench.limits.angle
    for k in range(n):
        u = requested[k]
        ahead = angle + 0.04 * velocity
        if planned is None and (ahead > highest - 25.0 or velocity > bench.limits.velocity - 120.0):
            u = -bench.limits.current * 0.7
        elif planned is None and (ahead < lowest + 6.0 or velocity < -(bench.limits.velocity - 120.0)):
            u = bench.limits.current * 0.7
        commanded = round(float(u), 3) if received else braking(bench, float(velocity))
        u = commanded if received and not (losses and losses.commands[k]) else braking(bench, state[1])
        b[_KM : _FV + 1] = constant * (1.0 + b[_KM_DRIFT : _FV_DRIFT + 1] * (k + 0.5) / n)
        b[_NOW] = (k + 0.5) / n
        settling = math.exp(-k * t_s / SETTLING)
        b[_KM] *= 1.0 + brake.k_m_settling * settling
        b[_TC] *= 1.0 + brake.t_c_settling * settling
        b[_BIAS] = brake.current_offset + brake.offset_drift * (k + 0.5) / n
        if brake.delay > 0.0:
            state = _move(b, state, before, brake.delay * t_s)
        late = brake.clock_jitter * rng.standard_normal() if brake.clock_jitter > 0.0 else 0.0
        if brake.stepped:
            seen = state = _step(b, state, u, t_s)
        else:
            begun = state
            state = _disturbed(brake, b, state, u, (1.0 - brake.delay) * t_s, rng)
            seen = _move(b, begun, u, (1.0 - brake.delay) * t_s + late) if late != 0.0 else state
        currents[k] = acted[k] = before = u
        shown = sensors.shown(seen[0], seen[1])
        received = losses is None or not losses.samples[k]
        if received:
            samples[k] = angle, velocity = shown
        else:
            samples[k], currents[k], assumed[k] = np.nan, commanded, commanded
    slack = bench.noise.angle / math.sqrt(AT_REST)
    at_origin = abs(rest[0]) <= ORIGIN_SIGMAS * slack
    if charge and losses is not None:
        lost = np.pad(losses.samples, 1)
        alone = losses.samples & ~lost[:-2] & ~lost[2:]
        alone[-1] = False  # after it nothing was received
        currents, assumed = np.where(alone, acted, currents), np.where(alone, np.nan, assumed)
    unreported = None if losses is None or not losses.samples.any() else assumed
    return Experiment(name, currents, samples, float(rest[0]), 0.0, slack, bool(at_origin), assumed=unreported)


def motion(brake: Brake, currents: Floats, t_s: float) -> Floats:
    """Angle [rad] and velocity [rad/s] at the ends of the periods of a brake from rest at the origin, shape (n, 2)."""
    b, state, found = brake.numbers(), (0.0, 0.0, brake.current_offset, 0.0, 0.0), np.empty((len(currents), 2))
    for k, u in enumerate(currents.tolist()):
        state = _move(b, state, u, t_s)
        found[k] = state[:2]
    return found


def clamped(
    brake: Brake, bench: Bench, law: Callable[[float, float, int], float], periods: int, rng: np.random.Generator
) -> Floats:
    """True clamping force at the ends of the periods of a brake from rest at the origin [N], shape (periods,).

    A law answers the angle [rad] and velocity [rad/s] that are shown before each period with a current [A].
    """
    b, state, found = brake.numbers(), (0.0, 0.0, brake.current_offset, 0.0, 0.0), np.empty(periods)
    sensors = _Sensors(brake, bench, rng)
    for k in range(periods):
        angle, velocity = sensors.shown(state[0], state[1]).tolist()
        state = _move(b, state, law(angle, velocity, k), bench.timing.sample_time)
        x, _, _, z, w = state
        found[k] = _force(b, x, z, w)
    return found


def _disturbed(  # type: ignore[no-untyped-def]
    brake: Brake, b: Floats, state, u: float, duration: float, rng: np.random.Generator
):
    """A motion with one command while the velocity is kicked and the load changes, each at random."""
    if brake.velocity_walk == brake.torque_walk == 0.0:
        return _move(b, state, u, duration)
    root = math.sqrt(duration / KICKS)
    for kick, change in rng.standard_normal((KICKS, 2)) * root * [brake.velocity_walk, brake.torque_walk / b[_KM]]:
        b[_BIAS] += change
        x, v, i, z, w = _move(b, state, u, duration / KICKS)
        state = x, v + kick, i, z, w
    return state


def started(record: Experiment, plant: Plant) -> Experiment:
    """The record as a model of that plant takes it, whose encoder's offset defines the origin."""
    at_origin = abs(record.angle - plant.instruments.encoder_offset) <= ORIGIN_SIGMAS * record.slack
    return replace(record, from_origin=bool(at_origin))


def excitation(rng: np.random.Generator, n: int, most: float) -> Floats:
    """Random steps, a square wave or a chirp [A]."""
    k, kind = np.arange(n), rng.integers(3)
    if kind == 0:
        edges = np.cumsum(rng.integers(5, 40, n))
        levels = rng.uniform(-1.0, 1.0, n) * most
        return np.asarray(levels[np.searchsorted(edges, k)])
    if kind == 1:
        period = rng.uniform(30.0, 120.0)
        return np.asarray(most * rng.uniform(0.4, 0.9) * np.sign(np.sin(2.0 * np.pi * k / period + 0.1)))
    last = rng.uniform(20.0, 60.0) * 1e-3
    return np.asarray(
        most * rng.uniform(0.4, 0.9) * np.sin(2.0 * np.pi * (2.0 * k + 0.5 * last * k * k / n * 2) * 1e-3)
    )
