"""The search that tries to break the learning shield: adversarial episodes of a whole closed loop, compiled.

Policies, lost commands and the way brakes are drawn are those of :mod:`tests.properties.shield_search`. The noise is
of the learner's kind: at its bound, aligned with the motion or with the second difference of angles, or such that the
brake looks like another one of the set for as long as it can (*impersonation*). The brakes are the two that can be
declared: forward Euler and the exact flow.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.brake.motion import SENSITIVE, STATES, advance
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_bench.config.plants import Mechanics
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters, Ranges
from emb_runtime.learning.assumptions import Assumptions, assumptions_of
from emb_runtime.learning.bounded import hear, lose, start
from emb_runtime.learning.known import HIGH, LOW, Known, known
from emb_runtime.learning.law import law_for, middle
from emb_runtime.safety.shield import NO_PAST, damped_current, shield
from emb_runtime.safety.shield_design import DesignInputs, ShieldLaw, design_inputs, make_law
from tests.properties.shield_search import (
    DROPS,
    LOST,
    POLICIES,
    REVERSE_WHEN_LIMITED,
    Codes,
    Floats,
    Generator,
    _is_lost,
    _kinds,
    _wanted,
    draw_brakes,
)

CHUNK = 500  # Episodes drawn at once
# Noise, by what it depends on: drawn numbers alone, the sign of the velocity, the time since the last reversal (such
# that a second difference of angles errs most, with sums of angles that err with it), or another brake that answers the
# same currents. The same patterns serve the errors of current and model.
DRAWN, SIGN, HAT, NOTCH, STEP, IMPERSONATE, ANCHORED = range(7)
# Columns of a result row.
OUTSIDE, REFUTED, LOWEST, HIGHEST, SLOWEST, FASTEST, END_ANGLE, END_VELOCITY, WIDTH, COUNT = range(10)


class Setting(NamedTuple):
    """What all episodes of a search have in common."""

    inputs: DesignInputs  # Of the bench
    nominal: BrakeParameters  # Brake that the parameters are relative to
    assumptions: Assumptions  # Of the learner
    law: ShieldLaw  # For the whole set
    plant: Mechanics
    excess: float  # Sensor noise over its bound


class Script(NamedTuple):
    """What was drawn for a chunk of episodes; the first axis counts them, the second samples."""

    brakes: Floats
    shadows: Floats  # Brakes that the noise impersonates
    wanted: Floats
    feedback: Codes
    touches: Codes
    noise: Codes  # Kind of the noise
    errors: Floats
    """Shares of the bounds: of the angle, the velocity, the current, the acceleration, shape [N, steps + 1, 4]."""
    period: Floats  # Of a hat [samples]
    drops: Codes
    silent: NDArray[np.bool_]  # The sample is lost with the command


def _side(kind: int, v: float, since: int, period: float) -> float:
    """What a drawn error is multiplied with."""
    if kind == SIGN:
        return math.copysign(1.0, v)
    if kind == HAT:
        phase = (since / period) % 1.0
        return 1.0 if phase < 0.25 or phase >= 0.75 else -1.0
    if kind == NOTCH:
        return -1.0 if since == int(period) else 1.0
    if kind == STEP:
        return -1.0 if 0 < since <= period else 1.0
    return 1.0


def _brake(b: Any) -> BrakeParameters:
    return BrakeParameters(float(b[0]), float(b[1]), float(b[2]), float(b[3]), float(b[4]), float(b[5]))


def _noise(s: Setting, script: Script, i: int, k: int, side: float, true: Any, shadow: Any) -> tuple[float, float]:
    """Errors of a measured angle [rad] and velocity [rad/s]; an anchored shadow goes on from what is seen of it."""
    a = s.assumptions
    most_y, most_w = a.angle_noise * s.excess, a.velocity_noise * s.excess
    if script.noise[i] < IMPERSONATE:
        return script.errors[i, k, 0] * side * most_y, script.errors[i, k, 1] * side * most_w
    y = min(max(shadow[0] - true[0], -most_y), most_y)
    w = min(max(shadow[1] - true[1], -most_w), most_w)
    if script.noise[i] == ANCHORED:
        shadow[0], shadow[1] = true[0] + y, true[1] + w
    return y, w


def _note(row: Any, x: float, v: float) -> None:
    row[LOWEST], row[HIGHEST] = min(row[LOWEST], x), max(row[HIGHEST], x)
    row[SLOWEST], row[FASTEST] = min(row[SLOWEST], v), max(row[FASTEST], v)


def _answer(s: Setting, script: Script, i: int, k: int, now: Known, seen: tuple[float, float], wish: float) -> Any:
    """The shield's current and its reasons."""
    if now.falsified:
        return shield(s.law, seen[0], seen[1], wish, NO_PAST, k)
    y, w = middle(now)
    return shield(law_for(s.inputs, s.nominal, now), y, w, wish, NO_PAST, k)


def _holds(nominal: BrakeParameters, possible: Known, brake: Any, angle: float, velocity: float) -> bool:
    """True if the true parameters, angle [rad] and velocity [rad/s] are among what is known to be possible."""
    k_m, k_1, t_c, f_v = brake[2] / nominal.k_m, brake[3] / nominal.k_1, brake[4] / nominal.T_c, brake[5] / nominal.f_v
    return bool(
        possible.k_m_low <= k_m <= possible.k_m_high
        and possible.k_1_low <= k_1 <= possible.k_1_high
        and possible.t_c_low <= t_c <= possible.t_c_high
        and possible.f_v_low <= f_v <= possible.f_v_high
        and possible.angle_low <= angle <= possible.angle_high
        and possible.velocity_low <= velocity <= possible.velocity_high
    )


def episode(s: Setting, script: Script, i: int, state: Any, row: Any) -> None:
    """Run one episode and write its results into ``row``."""
    a, t = s.assumptions, s.assumptions.sample_time
    b, kind = script.brakes[i], script.noise[i]
    p, q = _brake(b), _brake(script.shadows[i])
    true, shadow = np.zeros(STATES), np.zeros(STATES)
    chosen, slopes = np.zeros(0, np.int64), np.zeros((0, SENSITIVE))
    bits = touched = since = 0
    turn, current, last = 1.0, 0.0, 0.0
    for k in range(s.law.steps):
        x, v = float(true[0]), float(true[1])
        since = since + 1 if v * last > 0.0 else 0
        last = v
        side = _side(kind, v, since, script.period[i])
        y, w = _noise(s, script, i, k, side, true, shadow)
        y += x
        w += v
        lost = True
        if k > 0 and script.drops[i, k] == LOST and script.silent[i]:
            lose(a, state)
        else:
            hear(a, state, y, w, current)
            now = known(state)
            if now.falsified:
                row[REFUTED] += 1.0
            elif not _holds(s.nominal, now, b, x, v):
                row[OUTSIDE] += 1.0
            if script.feedback[i] == REVERSE_WHEN_LIMITED and bits & 2:
                touched += 1
                turn = -turn if touched % script.touches[i] == 0 else turn
            wish = turn * _wanted(script.feedback[i], script.wanted[i, k], v, s.law.current)
            current, bits = _answer(s, script, i, k, now, (y, w), wish)
            lost = _is_lost(script.drops[i, k], bits, x, v)
        if lost:
            current = damped_current(v, s.law.current, s.law.damping_velocity)
        acting = current + side * script.errors[i, k, 2] * a.current_error
        acting += side * script.errors[i, k, 3] * a.model_error * p.J / p.k_m
        advance(s.plant, p, true, acting, t, chosen, slopes)
        if kind >= IMPERSONATE:
            advance(s.plant, q, shadow, current, t, chosen, slopes)
        _note(row, float(true[0]), float(true[1]))
    row[END_ANGLE], row[END_VELOCITY] = true[0], true[1]
    for j in range(len(PARAMETER_NAMES)):
        row[WIDTH] += math.log(max(state[HIGH + j] - state[LOW + j], 1e-9))


def episodes(s: Setting, script: Script, begun: Floats, rows: Floats) -> None:
    """Run one episode per row; each begins with the learner's state ``begun``."""
    for i in range(rows.shape[0]):
        episode(s, script, i, begun.copy(), rows[i])


# --- Noise: (episodes, samples, 4) in shares of the bounds -----------------------------------------------------------


def _nothing(rng: Generator, m: int, n: int) -> Floats:
    return np.zeros((m, n, 4))


def _uniform(rng: Generator, m: int, n: int) -> Floats:
    return rng.uniform(-1.0, 1.0, (m, n, 4))


def _gaussian(rng: Generator, m: int, n: int) -> Floats:
    return np.clip(rng.normal(0.0, 1.0 / 6.0, (m, n, 4)), -1.0, 1.0)


def _coin_flips(rng: Generator, m: int, n: int) -> Floats:
    return rng.choice([-1.0, 1.0], (m, n, 4))


def _held(rng: Generator, m: int, n: int) -> Floats:
    """The same sign throughout, one for each of the four."""
    return np.broadcast_to(rng.choice([-1.0, 1.0], (m, 1, 4)), (m, n, 4)).copy()


def _square(rng: Generator, m: int, n: int) -> Floats:
    """Square waves, of one period and phases of their own."""
    period = np.exp(rng.uniform(math.log(2.0), math.log(200.0), (m, 1, 1)))
    wave = np.sin(2.0 * np.pi * (np.arange(n)[None, :, None] / period + rng.random((m, 1, 4))))
    return np.where(wave >= 0.0, 1.0, -1.0)


Plan = Callable[[Generator, int, int], Floats]
NOISES: dict[str, tuple[Plan, int]] = {
    "none": (_nothing, DRAWN),
    "Gaussian": (_gaussian, DRAWN),
    "uniform": (_uniform, DRAWN),
    "coin flips": (_coin_flips, DRAWN),
    "constant": (_held, DRAWN),
    "square waves": (_square, DRAWN),
    "sign-aligned": (_held, SIGN),
    "hat-aligned": (_held, HAT),
    "notch": (_held, NOTCH),
    "step": (_held, STEP),
    "impersonation": (_held, IMPERSONATE),
    "anchored impersonation": (_held, ANCHORED),
}


def setting_for(bench: Bench, flow: bool, excess: float = 1.0) -> Setting:
    """The exact flow or forward Euler is declared, and true; ``excess`` is sensor noise over its bound."""
    declared = replace(bench, shield=bench.shield._replace(learn=True, model="flow" if flow else "euler"))
    law = make_law(declared)
    mechanics = bench.plant("exact" if flow else "euler").mechanics
    return Setting(design_inputs(declared), bench.brake, assumptions_of(declared), law, mechanics, excess)


class Found(NamedTuple):
    """What a search found; the first axis of each array counts its episodes."""

    bench: Bench
    seed: int
    brakes: Floats
    labels: Codes  # Indices of policy, noise and drops
    rows: Floats

    @property
    def outside(self) -> NDArray[np.bool_]:
        """Episodes in which the truth was at some time not among what was known."""
        ever: NDArray[np.bool_] = self.rows[:, OUTSIDE] > 0.0
        return ever

    @property
    def falsified(self) -> NDArray[np.bool_]:
        """Episodes in which an assumption was found to be false."""
        ever: NDArray[np.bool_] = self.rows[:, REFUTED] > 0.0
        return ever

    @property
    def known(self) -> Floats:
        """Sum of the logarithms of the relative widths of the four parameters, at the end."""
        return self.rows[:, WIDTH]

    @property
    def violated(self) -> NDArray[np.bool_]:
        """Episodes that left a limit (NaN counts)."""
        r, limits = self.rows, self.bench.limits
        held = (r[:, LOWEST] >= limits.angle[0]) & (r[:, HIGHEST] <= limits.angle[1])
        left: NDArray[np.bool_] = ~(held & (r[:, SLOWEST] >= -limits.velocity) & (r[:, FASTEST] <= limits.velocity))
        return left

    @property
    def lossless(self) -> NDArray[np.bool_]:
        """Episodes that lost no command."""
        return np.equal(self.labels[:, 2], list(DROPS).index("none"))

    @property
    def away(self) -> NDArray[np.bool_]:
        """Episodes that lost no command and did not end at home."""
        r, shield = self.rows, self.bench.shield
        home = (np.abs(r[:, END_ANGLE]) <= shield.home_angle) & (np.abs(r[:, END_VELOCITY]) <= shield.home_velocity)
        return self.lossless & ~home

    def describe(self, i: int) -> str:
        """One episode in words."""
        policy, noise, drops = self.labels[i]
        r = self.rows[i]
        return (
            f"episode {i} of seed {self.seed}: {', '.join(f'{b:.6g}' for b in self.brakes[i])}; "
            f"{list(POLICIES)[policy]}; noise {list(NOISES)[noise]}; lost {list(DROPS)[drops]}; "
            f"outside {r[OUTSIDE]:.0f} times, falsified {r[REFUTED]:.0f}; "
            f"angle {r[LOWEST]:.3f}..{r[HIGHEST]:.3f} rad, velocity "
            f"{r[SLOWEST]:.1f}..{r[FASTEST]:.1f} rad/s, end {r[END_ANGLE]:.3f} rad {r[END_VELOCITY]:.2f} rad/s"
        )


def _shadows(rng: Generator, box: Ranges, brakes: Floats) -> Floats:
    """Other brakes of the set, from all of it down to a hundredth of the way."""
    share = 10.0 ** -rng.choice([0.0, 0.5, 1.0, 1.5, 2.0], (len(brakes), 1))
    shadows: Floats = brakes + share * (draw_brakes(rng, box, len(brakes)) - brakes)
    return shadows


def search(
    setting: Setting,
    bench: Bench,
    n: int,
    seed: int,
    run: Callable[[Setting, Script, Floats, Floats], None] = episodes,
) -> Found:
    """Run ``n`` random adversarial episodes against a learning shield, by ``run``, which may be a broken one."""
    box = bench.range_set(bench.shield.ranges)
    brakes, rows = np.zeros((n, len(BrakeParameters._fields))), np.zeros((n, COUNT))
    labels = np.zeros((n, 3), dtype=np.int64)
    begun = np.array(start(setting.assumptions))
    play, names, steps = compiled(run), list(DROPS), setting.law.steps
    for first in range(0, n, CHUNK):
        part = slice(first, min(first + CHUNK, n))
        m = part.stop - part.start
        rng = np.random.default_rng([seed, first])
        brakes[part] = draw_brakes(rng, box, m)
        drops = np.where(rng.random(m) < 0.5, 0, rng.integers(0, len(names), m))
        wanted, errors = np.zeros((m, steps)), np.zeros((m, steps, 4))
        codes = np.zeros((m, steps), dtype=np.int64)
        for j, draw in enumerate(DROPS.values()):
            codes[drops == j] = draw(rng, int(np.sum(drops == j)), steps)
        policy, feedback = _kinds(rng, m, POLICIES, steps, wanted)
        noise, kinds = _kinds(rng, m, NOISES, steps, errors)
        script = Script(
            brakes=brakes[part],
            shadows=_shadows(rng, box, brakes[part]),
            wanted=wanted,
            feedback=feedback,
            touches=rng.integers(1, 60, m),
            noise=kinds,
            errors=errors,
            period=np.exp(rng.uniform(math.log(4.0), math.log(200.0), m)),
            drops=codes,
            silent=rng.random(m) < 0.5,
        )
        labels[part] = np.stack([policy, noise, drops], axis=1)
        play(setting, script, begun, rows[part])
    return Found(bench, seed, brakes, labels, rows)
