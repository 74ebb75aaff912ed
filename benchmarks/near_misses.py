"""Small errors of the model: are they noticed, named, or at least inside the intervals?

    python benchmarks/near_misses.py [--draws 4] [--seed 1] [--method oem]

Half of the records are of the brake that the model describes, half of one with a small error of one of ``KINDS`` in one
of three sizes, all with random parameters within ±50 %, random excitations and the bench's noise. They are simulated
here, with steps of 20 µs of the classical Runge-Kutta method, a friction, a clearance and a quantisation of their own:
no line of it is the estimator's. Reported are

- of the records that are said to be usable, the share with a parameter further off than 3 stated deviations;
- false alarms: right records that are said not to fit;
- of the misfits that are noticed, how often the suspect that is named first is the right one;
- the median width of the intervals over that of a perfectly known bench, for right records;

each with its 95 % interval (Clopper and Pearson 1934).
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from emb_bench.estimate.methods import run_method
from emb_bench.estimate.records import Estimate, EstimationProblem, Record, with_systematic
from emb_bench.information.identifiability import Spectrum
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, load_bench

Floats = NDArray[np.float64]

STEP = 2e-5
"""Longest step of the simulation [s]."""
AT_REST = 50
"""Samples before the experiment."""
FAR = 3.0
"""Stated deviations beyond which a value that is said to be usable is wrong."""
ANGLE_STEP, VELOCITY_STEP = 1e-4, 0.01
"""Quantisation of what is sent [rad] and [rad/s]."""


class Kind(NamedTuple):
    """One small error of the model."""

    sizes: tuple[float, float, float]
    unit: str
    named: tuple[str, ...]
    """Suspects that lead to the remedy."""
    params: tuple[str, ...] = PARAMETER_NAMES
    """Parameters that are estimated."""


KINDS: Mapping[str, Kind] = {
    "encoder offset": Kind((0.002, 0.01, 0.05), "rad", ("offset", "contact")),
    "current offset": Kind((0.002, 0.01, 0.05), "A", ("current_offset",)),
    "delay": Kind((0.005, 0.03, 0.2), "samples", ("delay",)),
    "velocity gain": Kind((0.0005, 0.003, 0.02), "1", ("velocity_gain",)),
    "quadratic stiffness": Kind((3e-6, 1e-5, 1e-4), "1/rad", ("quadratic",)),
    "cubic stiffness": Kind((3e-8, 3e-7, 3e-6), "1/rad²", ("cubic", "quadratic")),
    "play": Kind((0.01, 0.05, 0.2), "rad", ("play", "hysteresis")),
    "Stribeck friction": Kind((0.003, 0.02, 0.1), "1", ("stribeck", "break_away")),
    "hysteresis": Kind((0.0003, 0.002, 0.01), "1", ("hysteresis",)),
    "current lag": Kind((1e-5, 5e-5, 3e-4), "s", ("current_lag",)),
    "friction by direction": Kind((0.001, 0.01, 0.05), "1", ("current_offset", "asymmetry")),
    "held stiffness": Kind((1e-4, 1e-3, 1e-2), "1", ("k_1",), ("k_m", "T_c", "f_v")),
}


@dataclass(frozen=True)
class Brake:
    """A brake, and what is wrong with the model of it or with its sensors."""

    k_m: float
    k_1: float
    t_c: float
    f_v: float
    inertia: float
    gamma: float
    encoder_offset: float = 0.0
    current_offset: float = 0.0
    delay: float = 0.0
    velocity_gain: float = 0.0
    quadratic: float = 0.0
    cubic: float = 0.0
    play: float = 0.0
    stribeck: float = 0.0
    """Share of the static friction beyond T_c, gone at 30 rad/s."""
    hysteresis: float = 0.0
    current_lag: float = 0.0
    asymmetry: float = 0.0
    """Share by which the friction of the positive direction is larger, that of the other smaller."""

    def numbers(self) -> Floats:
        """All of them in one row, as the integration takes them."""
        return np.array(list(vars(self).values()))


STRIBECK_VELOCITY = 30.0
HYSTERESIS_TRAVEL = 1.0
# Places in ``Brake.numbers``.
_KM, _K1, _TC, _FV, _J, _GAMMA, _, _BIAS, _, _, _QUAD, _CUBE, _PLAY, _STRIBECK, _HYST, _LAG, _ASYM = range(17)


@numba.njit(cache=False)
def _force(b, x, z, w):  # type: ignore[no-untyped-def]
    """Clamping force: of the travel behind the clearance, with a hysteresis."""
    travel = x if b[_PLAY] == 0.0 else z
    if travel <= 0.0:
        return 0.0
    return b[_K1] * travel * (1.0 + b[_QUAD] * travel + b[_CUBE] * travel * travel) * (1.0 + b[_HYST] * w)


@numba.njit(cache=False)
def _follow(b, x, z, w, moved):  # type: ignore[no-untyped-def]
    """Clearance and hysteresis after the angle has moved."""
    half = 0.5 * b[_PLAY]
    z = min(max(z, x - half), x + half)
    w = 0.0 if x <= 0.0 else min(max(w + moved / HYSTERESIS_TRAVEL, -1.0), 1.0)
    return z, w


@numba.njit(cache=False)
def _friction(b, v, sign):  # type: ignore[no-untyped-def]
    share = b[_STRIBECK] * math.exp(-((v / STRIBECK_VELOCITY) ** 2)) if b[_STRIBECK] > 0.0 else 0.0
    return b[_TC] * (1.0 + b[_ASYM] * sign) * (1.0 + share)


@numba.njit(cache=False)
def _slope(b, x, v, i, z0, w0, x0, sign):  # type: ignore[no-untyped-def]
    z, w = _follow(b, x, z0, w0, x - x0)
    torque = b[_KM] * i - b[_GAMMA] * _force(b, x, z, w) - b[_FV] * v - sign * _friction(b, v, sign)
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
    u, left = command + b[_BIAS], duration
    if b[_LAG] == 0.0:
        i = u
    while left > 1e-15:
        h = min(STEP, left)
        if v == 0.0:
            drive = b[_KM] * _current(b, i, u, h) - b[_GAMMA] * _force(b, x, z, w)
            sign = 1.0 if drive > 0.0 else -1.0
            if abs(drive) <= _friction(b, 0.0, sign):
                i = _current(b, i, u, h)
                left -= h
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
        left -= h
    return x, v, i, z, w


def simulate(brake: Brake, bench: Bench, rng: np.random.Generator, name: str) -> Record:
    """An experiment: a random excitation that is turned around near the limits, and home at the end."""
    n, t_s, b = bench.timing.horizon, bench.timing.sample_time, brake.numbers()
    sigma = np.array([bench.noise.angle, bench.noise.velocity])
    wanted = excitation(rng, n, bench.limits.current)
    state, before = (0.0, 0.0, brake.current_offset, 0.0, 0.0), 0.0
    currents, samples = np.empty(n), np.empty((n, 2))

    def measured() -> Floats:
        true = np.array([state[0] + brake.encoder_offset, state[1] * (1.0 + brake.velocity_gain)])
        noisy = true + sigma * rng.standard_normal(2)
        return np.round(noisy / [ANGLE_STEP, VELOCITY_STEP]) * [ANGLE_STEP, VELOCITY_STEP]

    rest = np.mean([measured() for _ in range(AT_REST)], axis=0)
    angle, velocity = rest
    lowest, highest = bench.limits.angle
    for k in range(n):
        u = wanted[k]
        ahead = angle + 0.04 * velocity
        if ahead > highest - 25.0 or velocity > bench.limits.velocity - 120.0:
            u = -bench.limits.current * 0.7
        elif ahead < lowest + 6.0 or velocity < -(bench.limits.velocity - 120.0):
            u = bench.limits.current * 0.7
        u = round(float(u), 3)
        if brake.delay > 0.0:
            state = _move(b, state, before, brake.delay * t_s)
        state = _move(b, state, u, (1.0 - brake.delay) * t_s)
        currents[k], before = u, u
        samples[k] = angle, velocity = measured()
    slack = bench.noise.angle / math.sqrt(AT_REST)
    at_origin = abs(rest[0]) <= 4.0 * slack
    return Record(name, currents, samples, float(rest[0]), 0.0, slack, bool(at_origin))


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


def draw(bench: Bench, kind: str | None, size: float, rng: np.random.Generator) -> Brake:
    """A random brake within ±50 %; ``kind`` and ``size`` say what is wrong with the model."""
    factors = rng.uniform(0.5, 1.5, 4)
    if kind is not None and KINDS[kind].params != PARAMETER_NAMES:
        factors[1] = 1.0 + size
    p = bench.brake
    brake = Brake(p.k_m * factors[0], p.k_1 * factors[1], p.T_c * factors[2], p.f_v * factors[3], p.J, p.gamma)
    errors = {
        "encoder offset": "encoder_offset",
        "current offset": "current_offset",
        "delay": "delay",
        "velocity gain": "velocity_gain",
        "quadratic stiffness": "quadratic",
        "cubic stiffness": "cubic",
        "play": "play",
        "Stribeck friction": "stribeck",
        "hysteresis": "hysteresis",
        "current lag": "current_lag",
        "friction by direction": "asymmetry",
    }
    return Brake(**{**vars(brake), **({errors[kind]: size} if kind in errors else {})})


class Outcome(NamedTuple):
    """Answer to one record beside the truth."""

    kind: str | None
    size: float
    fits: bool
    farthest: float
    """Largest error of a parameter, in stated deviations."""
    covered: float
    """Share of the parameters inside their 95 % intervals."""
    suspect: str
    wider: float
    """Median stated deviation over the Cramér-Rao bound of the parameters alone."""
    seconds: float


def judge(bench: Bench, brake: Brake, record: Record, kind: str | None, size: float, method: str) -> Outcome:
    """Estimates, and compares what is said with what is true."""
    params = PARAMETER_NAMES if kind is None else KINDS[kind].params
    begun = time.perf_counter()
    e = estimated(bench, record, params, method)
    seconds = time.perf_counter() - begun
    true = {"k_m": brake.k_m, "k_1": brake.k_1, "T_c": brake.t_c, "f_v": brake.f_v}
    index = [i for i, u in enumerate(e.unknowns) if u.name in params]
    errors = np.array([e.values[i] / true[e.unknowns[i].name] - 1.0 for i in index])
    deviations, intervals = e.deviations()[index], e.intervals()[index]
    truths = np.array([true[e.unknowns[i].name] for i in index])
    covered = float(np.mean((intervals[:, 0] <= truths) & (truths <= intervals[:, 1])))
    alone = np.sqrt(np.diag(Spectrum(e.information[np.ix_(index, index)]).inverse()))  # inf where nothing is told
    suspects = e.validation.suspects
    farthest = float(np.max(np.abs(errors) / deviations))
    name = suspects[0].name if suspects else ""
    return Outcome(
        kind, size, e.validation.fits, farthest, covered, name, float(np.nanmedian(deviations / alone)), seconds
    )


def estimated(bench: Bench, record: Record, params: tuple[str, ...], method: str) -> Estimate:
    """The estimate as the command makes it."""
    plant = bench.plant("exact")
    return run_method(method, bench, plant, [record], with_systematic(EstimationProblem(params), bench, plant))


def share(part: int, of: int) -> str:
    """A share with its 95 % interval."""
    if of == 0:
        return "none of 0"
    low = 0.0 if part == 0 else float(stats.beta.ppf(0.025, part, of - part + 1))
    high = 1.0 if part == of else float(stats.beta.ppf(0.975, part + 1, of - part))
    return f"{part} of {of} = {100 * part / of:.1f} % ({100 * low:.1f} to {100 * high:.1f} %)"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="small errors of the model: noticed, named, or inside the intervals?")
    parser.add_argument("--draws", type=int, default=4, help="records of each kind and size (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the first record (default: %(default)s)")
    parser.add_argument("--method", default="oem", choices=("oem", "ensemble"), help="default: %(default)s")
    args = parser.parse_args()
    bench, outcomes, seed = load_bench(), [], args.seed
    jobs = [(kind, size) for kind, k in KINDS.items() for size in k.sizes for _ in range(args.draws)]
    print(f"seeds {args.seed} to {args.seed + 2 * len(jobs) - 1}, method {args.method}")
    for wrong, size in jobs:
        for kind in (wrong, None):
            rng = np.random.default_rng(seed)
            brake = draw(bench, kind, size, rng)
            record = simulate(brake, bench, rng, f"seed {seed}")
            outcomes.append(judge(bench, brake, record, kind, size, args.method))
            seed += 1
    report(outcomes)


def report(outcomes: list[Outcome]) -> None:
    """The tables."""
    print(f"\n{'kind':22}{'size':>9} {'':8}{'noticed':>9}{'named':>7}{'usable':>8}{'off > 3':>9}{'worst':>8}")
    for kind, k in KINDS.items():
        for size in k.sizes:
            own = [o for o in outcomes if o.kind == kind and o.size == size]
            noticed = [o for o in own if not o.fits]
            usable = [o for o in own if o.fits]
            named = sum(o.suspect in k.named for o in noticed)
            far = sum(o.farthest > FAR for o in usable)
            worst = max((o.farthest for o in usable), default=0.0)
            print(
                f"{kind:22}{size:9.2g} {k.unit:8}{len(noticed):9}{named:7}{len(usable):8}{far:9}{worst:8.1f}  "
                + ", ".join(sorted({o.suspect for o in noticed}))
            )
    right, near = [o for o in outcomes if o.kind is None], [o for o in outcomes if o.kind is not None]
    usable, noticed = [o for o in outcomes if o.fits], [o for o in near if not o.fits]
    near_usable = [o for o in near if o.fits]
    named = sum(o.suspect in KINDS[str(o.kind)].named for o in noticed)
    print(f"\n{len(right)} right records, {len(near)} near misses")
    print("usable, but a parameter is beyond 3 deviations:", share(sum(o.farthest > FAR for o in usable), len(usable)))
    far = sum(o.farthest > FAR for o in near_usable)
    print("  of the near misses alone:                    ", share(far, len(near_usable)))
    print("false alarms:                                  ", share(sum(not o.fits for o in right), len(right)))
    print("near misses that are noticed:                  ", share(len(noticed), len(near)))
    print("suspect named first is right, where noticed:   ", share(named, len(noticed)))
    print(f"95 % intervals cover, right records:            {100 * np.mean([o.covered for o in right]):.1f} %")
    if near_usable:
        print(
            f"95 % intervals cover, usable near misses:       {100 * np.mean([o.covered for o in near_usable]):.1f} %"
        )
    found = np.array([o.wider for o in right])
    wider = found[np.isfinite(found)]
    print(f"deviation over that of a known bench, right:    median {np.median(wider):.2f}, largest {np.max(wider):.2f}")
    print(f"seconds an estimate takes:                      median {np.median([o.seconds for o in outcomes]):.3f}")


if __name__ == "__main__":
    main()
