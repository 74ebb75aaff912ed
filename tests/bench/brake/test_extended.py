from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from emb_bench.brake.exact import advance_exact
from emb_bench.brake.extended import advance_extended
from emb_bench.brake.motion import Floats, no_sensitivity, rest
from emb_bench.brake.parameters import FEATURES, PARAMETERS
from emb_bench.compiled import compiled
from emb_bench.config.bench import load_bench
from emb_bench.config.plants import Mechanics
from emb_runtime.config.bench import BrakeParameters
from tests.bench.flows import Events, difference, events, whole

BENCH = load_bench()
P = BENCH.brake
T_S = 1e-3
PLAIN = Mechanics()
PLANTS = {
    **{name: BENCH.plant(name).mechanics for name in ("stribeck", "load", "cubic", "hysteresis", "lag", "rough")},
    "stiction": Mechanics(break_away=1.3),
    "stiction behind a lag": Mechanics(
        break_away=1.3, current_lag=0.002, f_l=2e-6, hysteresis=0.2, hysteresis_travel=0.5
    ),
    "a curve with a kink at rest": Mechanics(
        break_away=1.3, stribeck_velocity=3.0, stribeck_exponent=1.0, f_l=2e-5, hysteresis=0.3, hysteresis_travel=0.1
    ),
    "an odd exponent": Mechanics(
        break_away=1.3, stribeck_velocity=10.0, stribeck_exponent=1.3, quadratic=0.01, cubic=1e-4, hysteresis=0.3
    ),
    "play": Mechanics(play=0.5),
    "wide play behind a lag": Mechanics(
        play=2.0, break_away=1.2, stribeck_velocity=20.0, f_l=2e-6, quadratic=0.005, current_lag=0.001
    ),
}
OF_THE_BRAKE = ("k_m", "k_1", "T_c", "f_v", "J")
OF_THE_START = ("contact", "delay", "current_offset", "x1_0", "x2_0")
DIFFERENCE = 3e-5  # Step of the finite differences, relative or in the unknown's unit


def run(
    m: Mechanics, p: BrakeParameters, currents: Floats, x0: tuple[float, float], params: tuple[str, ...] = ()
) -> tuple[Floats, Floats]:
    """States at the samples, shape (n, 4), and sensitivities of angle and velocity, shape (n, params, 2)."""
    states, shown = whole(m, p, currents, x0, params)
    return states[1:], shown


def meaningful(m: Mechanics, x0: tuple[float, float]) -> list[str]:
    """Unknowns whose derivative is two-sided there: no feature that is absent, no velocity of a brake at rest."""
    names = [*OF_THE_BRAKE, *(n for n in FEATURES if getattr(m, n) != getattr(PLAIN, n)), *OF_THE_START]
    return [n for n in names if n != "x2_0" or x0[1] != 0.0]


def compare(m: Mechanics, currents: Floats, x0: tuple[float, float]) -> tuple[int, int]:
    """Check the sensitivities against finite differences; numbers of comparisons made and left out.

    Left out is what is no derivative: an event comes, goes or passes a sample within the step, so that the directions
    of motion differ, or else half the step gives another result (2e-5 of the largest value).
    """
    names = meaningful(m, x0)
    _, shown = run(m, P, currents, x0, tuple(names))
    made = 0
    for j, name in enumerate(names):
        coarse, same = difference(m, P, currents, x0, name, DIFFERENCE)
        fine, _ = difference(m, P, currents, x0, name, 0.5 * DIFFERENCE)
        slope = (4.0 * fine - coarse) / 3.0
        # Where nothing depends on it, a difference is the solver's error over the step.
        largest = np.maximum(np.abs(slope).max(axis=0), 1e-2)
        if not same or (np.abs(fine - coarse) > 2e-5 * largest).any():
            continue
        made += 1
        unit = 1.0 if name not in FEATURES or PARAMETERS[name].relative else getattr(m, name)
        worst = (np.abs(unit * shown[:, j] - slope) / largest).max()
        assert worst < 1e-4, f"{name}: off by {worst:.1e} of the largest value, from {x0} with {m}"
    return made, len(names) - made


def drawn(rng: np.random.Generator) -> tuple[Floats, tuple[float, float]]:
    """Currents that reverse, stop, hold and release the brake and let it leave contact; and a start."""
    levels = rng.uniform(-3.0, 3.0, 12) * rng.choice([0.3, 1.0])
    start = (float(rng.uniform(-3.0, 20.0)), float(rng.choice([0.0, rng.uniform(-50.0, 50.0)])))
    return np.repeat(levels, rng.integers(3, 25, 12)), start


@pytest.mark.parametrize("name", PLANTS)
def test_sensitivities_are_the_finite_differences_of_the_flow(name: str) -> None:
    m, rng = PLANTS[name], np.random.default_rng(5)
    counts, seen = np.zeros(2, int), np.zeros(6, int)
    for _ in range(24):
        currents, x0 = drawn(rng)
        counts += compare(m, currents, x0)
        seen += events(run(m, P, currents, x0)[0], m)
    assert (seen[:4] > 5).all(), f"the inputs did not do everything: {Events(*seen)}"
    assert m.hysteresis == m.play == 0.0 or seen[4] > 5
    assert counts[1] < 0.08 * counts.sum(), f"{counts[1]} of {counts.sum()} left out"


@st.composite
def mechanics(draw: st.DrawFn, play: bool = False) -> Mechanics:
    """Any composition of the features; exponents are whole numbers, see the module's word on accuracy.

    With ``play`` there is one, in place of a hysteresis, and friction decays less steeply: below 5 rad/s the steps that
    the solver chooses, which no sensitivity follows, make 1e-4 of the differences.
    """
    off = Mechanics()
    values = {
        "break_away": st.floats(1.05, 2.0),
        "stribeck_velocity": st.floats(2.0, 60.0),
        "stribeck_exponent": st.sampled_from([1.0, 2.0, 3.0]),
        "f_l": st.floats(1e-7, 1e-5),
        "quadratic": st.floats(-5e-3, 0.02),
        "cubic": st.floats(-5e-5, 1e-3),
        "hysteresis": st.floats(0.01, 0.4),
        "current_lag": st.floats(2e-4, 0.02),
    }
    if play:
        del values["hysteresis"]
        values["stribeck_velocity"] = st.floats(5.0, 60.0)
        off = off._replace(play=draw(st.floats(0.01, 3.0)))
    chosen = {name: draw(values[name]) for name in sorted(draw(st.sets(st.sampled_from(sorted(values)))))}
    return Mechanics(**(off._asdict() | {"hysteresis_travel": draw(st.floats(0.05, 20.0))} | chosen))


@st.composite
def inputs(draw: st.DrawFn) -> tuple[Floats, tuple[float, float]]:
    """On grids whose points lie off contact, so that no difference straddles it at the start."""
    pieces = draw(st.lists(st.tuples(st.integers(-3000, 3000), st.integers(1, 30)), min_size=1, max_size=8))
    currents = np.concatenate([np.full(length, level / 1000.0) for level, length in pieces])
    return currents, ((draw(st.integers(-48, 320)) + 0.5) / 16.0, float(draw(st.integers(-50, 50))))


@settings(deadline=None, max_examples=150)
@given(mechanics() | mechanics(play=True), inputs())
def test_sensitivities_of_any_composition_are_the_differences_of_its_flow(
    m: Mechanics, given_inputs: tuple[Floats, tuple[float, float]]
) -> None:
    compare(m, *given_inputs)


@settings(deadline=None, max_examples=100)
@given(inputs())
def test_without_features_the_brake_is_the_exact_one(given_inputs: tuple[Floats, tuple[float, float]]) -> None:
    currents, x0 = given_inputs
    chosen, s = no_sensitivity((*OF_THE_BRAKE, *OF_THE_START))
    x, y, t = rest(), rest(), s.copy()
    x[:2] = y[:2] = x0
    largest = np.full(s[:, :2].shape, 1e-3)
    for u in currents:
        compiled(advance_extended)(PLAIN, P, x, float(u), T_S, chosen, s)
        compiled(advance_exact)(P, y, float(u), T_S, chosen, t)
        largest = np.maximum(largest, np.abs(t[:, :2]))
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-9)
        assert (np.abs(s - t)[:, :2] < 1e-7 * largest).all()


@settings(deadline=None, max_examples=60)
@given(mechanics() | mechanics(play=True), inputs())
def test_the_compiled_brake_is_the_plain_one_bit_for_bit(
    m: Mechanics, given_inputs: tuple[Floats, tuple[float, float]]
) -> None:
    currents, x0 = given_inputs
    chosen, s = no_sensitivity([n for n in PARAMETERS if n != "offset"])
    x, y, t = rest(), rest(), s.copy()
    x[:2] = y[:2] = x0
    for u in currents[:40]:
        advance_extended(m, P, x, float(u), T_S, chosen, s)
        compiled(advance_extended)(m, P, y, float(u), T_S, chosen, t)
        assert (x.tobytes(), s.tobytes()) == (y.tobytes(), t.tobytes())


def torques(m: Mechanics, t: float, y: Floats, i: float, u: float) -> tuple[float, float]:
    """What drives the brake, and the static friction [N·m], a time ``t`` into a period that began with ``i``."""
    motor = P.k_m * (u + (i - u) * math.exp(-t / m.current_lag) if m.current_lag else u)
    x = max(y[0] - (y[2] if m.play else 0.0), 0.0)
    force = P.k_1 * (x + m.quadratic * x**2 + m.cubic * x**3) * (1.0 + m.hysteresis * y[2])
    return motor - P.gamma * force, m.break_away * P.T_c + m.f_l * force


def released(m: Mechanics, t: float, y: Floats, i: float, u: float) -> float:
    """When a brake at rest breaks away, or the end of the period [s]."""

    def margin(t: float) -> float:
        pull, static = torques(m, t, y, i, u)
        return static - abs(pull)

    if margin(t) <= 0.0:
        return t
    return float(brentq(margin, t, T_S, xtol=1e-15)) if margin(T_S) < 0.0 else T_S


def solved(m: Mechanics, currents: Floats, x0: tuple[float, float]) -> Floats:
    """The same brake by scipy's solver with its own event search, written from the equations; states (n, 3)."""
    y, i, states = np.array([*x0, 0.0]), 0.0, []
    for u in currents:
        t = 0.0
        while t < T_S:
            if y[1] == 0.0:
                t = released(m, t, y, i, u)
                if t == T_S:
                    break
            t, y = slid(m, t, y, i, u)
        i = u + (i - u) * math.exp(-T_S / m.current_lag) if m.current_lag else u
        states.append(y.copy())
    return np.array(states)


def slid(m: Mechanics, t: float, y: Floats, i: float, u: float) -> tuple[float, Floats]:
    """Time and state at the next event or at the end of the period."""
    d = float(np.sign(y[1] or torques(m, t, y, i, u)[0]))
    inside = y[0] > 0.0 or (y[0] == 0.0 and d > 0.0)
    limit, contact = (0.5 * m.play, 0.5 * m.play * d) if m.play else (1.0, 0.0)
    follows = bool(m.play or (inside and m.hysteresis > 0.0)) and y[2] * d < limit
    per_angle = 1.0 if m.play else 1.0 / m.hysteresis_travel

    def rate(t: float, y: Floats) -> list[float]:
        pull, static = torques(m, t, y, i, u)
        left = math.exp(-(abs(y[1] / m.stribeck_velocity) ** m.stribeck_exponent)) if m.stribeck_velocity else 0.0
        friction = d * (P.T_c + (static - P.T_c) * left) + P.f_v * y[1]
        return [y[1], (pull - friction) / P.J, y[1] * per_angle if follows else 0.0]

    def stop(_t: float, y: Floats) -> float:
        return float(y[1] * d)

    def border(_t: float, y: Floats) -> float:
        return float((y[0] - contact) * d)

    def saturation(_t: float, y: Floats) -> float:
        return float(y[2] * d - limit)

    stop.terminal = border.terminal = saturation.terminal = True  # type: ignore[attr-defined]
    stop.direction, border.direction, saturation.direction = -1, 1, 1  # type: ignore[attr-defined]
    ahead = (y[0] - contact) * d < 0.0 and not (m.play and follows)
    watched = [stop, *([border] if ahead else []), *([saturation] if follows else [])]
    found = solve_ivp(rate, (t, T_S), y, "DOP853", events=watched, rtol=1e-11, atol=1e-12)
    end = found.y[:, -1].copy()
    if found.status == 1:
        event = watched[next(k for k, times in enumerate(found.t_events) if len(times))]
        if event is stop:
            end[1] = 0.0
        elif event is border:
            end[0], end[2] = (contact, y[2]) if m.play else (0.0, 0.0)
        else:
            end[2] = d * limit
    return float(found.t[-1]), end


@pytest.mark.parametrize("name", PLANTS)
def test_the_motion_is_that_of_a_general_solver_with_events(name: str) -> None:
    m, rng, seen = PLANTS[name], np.random.default_rng(5), np.zeros(6, int)
    for _ in range(6):
        currents, x0 = drawn(rng)
        found, expected = run(m, P, currents, x0)[0], solved(m, currents, x0)
        np.testing.assert_allclose(found[:, 0], expected[:, 0], rtol=0, atol=5e-7)
        np.testing.assert_allclose(found[:, 1], expected[:, 1], rtol=0, atol=5e-6)
        np.testing.assert_allclose(found[:, 2], expected[:, 2], rtol=0, atol=5e-6)
        seen += events(found, m)
    assert (seen[:4] > 0).all(), f"the inputs did not do everything: {Events(*seen)}"


def test_a_stop_between_two_samples_of_forward_motion_is_not_overlooked() -> None:
    # Friction stops the brake while the current rises, which then breaks it away again, all within 0.3 ms.
    m, names = Mechanics(current_lag=2e-3, break_away=1.2), ("T_c", "k_m", "current_lag")
    ends, slowest = [], math.inf
    for parts in (1, 1000):
        x, (chosen, s) = np.array([-5.0, 0.14, 0.0, 0.06]), no_sensitivity(names)
        for _ in range(parts):
            advance_extended(m, P, x, 6.0, T_S / parts, chosen, s)
            slowest = min(slowest, x[1])
        ends.append((x, s[:, :2]))
    assert slowest == 0.0
    assert ends[0][0][1] > 3.0
    np.testing.assert_allclose(ends[0][0], ends[1][0], rtol=1e-8)
    np.testing.assert_allclose(ends[0][1], ends[1][1], rtol=1e-5)


def test_at_rest_the_velocity_is_exactly_zero_and_depends_on_nothing() -> None:
    m = BENCH.plant("rough").mechanics
    names = ("k_m", "k_1", "T_c", "f_v", "break_away", "current_lag")
    states, shown = run(m, P, np.repeat([1.5, 0.45], [60, 240]), (-0.5, 0.0), names)
    assert (states[-50:, 1] == 0.0).all()
    assert (states[-50:, 0] == states[-1, 0]).all()
    assert (shown[-50:, :, 1] == 0.0).all()
    assert np.abs(shown[-1, :, 0]).max() > 0.1


@settings(deadline=None, max_examples=60)
@given(mechanics(), inputs())
def test_a_brake_without_current_never_gains_energy(
    m: Mechanics, given_inputs: tuple[Floats, tuple[float, float]]
) -> None:
    # Without hysteresis or play the clamped brake has a potential, and friction only takes.
    m = m._replace(hysteresis=0.0, play=0.0)
    _, x0 = given_inputs
    states = run(m, P, np.zeros(200), x0)[0]
    x = np.maximum(np.concatenate([[x0[0]], states[:, 0]]), 0.0)
    v = np.concatenate([[x0[1]], states[:, 1]])
    potential = P.gamma * P.k_1 * x**2 * (0.5 + x * (m.quadratic / 3.0 + x * m.cubic / 4.0))
    energy = 0.5 * P.J * v**2 + potential
    assert (np.diff(energy) <= 1e-12 * energy[0]).all()


def test_a_state_that_is_not_a_number_does_not_hang() -> None:
    x, (nothing, s) = rest(), no_sensitivity(())
    x[:2] = 1.0, math.nan
    advance_extended(BENCH.plant("rough").mechanics, P, x, 1.0, T_S, nothing, s)
    assert math.isnan(x[0])
