"""The shield's law against the definitions of its numbers, and each refusal against the inequality that it names.

The benches are drawn at random; what a law must hold is written down here once more, from the bench alone.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from random import Random
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from emb_runtime.config.bench import PARAMETER_NAMES, Bench, Limits, Noise, Ranges, Sensors, Shield
from emb_runtime.errors import BenchFileError
from emb_runtime.safety.shield_design import (
    chatter_excess,
    coasting_excess,
    damped_excess,
    hidden_by,
    late_step,
    law_of,
    make_law,
    stoppable,
    unseen,
)
from tests.benches import SENSOR_BENCH
from tests.laws import numbers, with_numbers

SHIPPED = SENSOR_BENCH
PAD = 0.3  # rad/s, as docs/explanation/shield.md says
KINDS = [
    pytest.param({}, id="fresh"),
    pytest.param({"frame_age": (0, 3)}, id="late"),
    pytest.param({"frame_age": (2, 2)}, id="of one age"),
    pytest.param({"current_lag": 0.002}, id="lagging"),
    pytest.param({"observer": 900.0}, id="observed"),
    pytest.param({"observer": 1800.0, "frame_age": (0, 1)}, id="observed, late"),
    pytest.param({"observer": 5000.0}, id="observed without delay"),
    pytest.param({"angle_low": -4.0}, id="short stroke"),
    pytest.param({"angle_low": -20.0, "angle_high": 5.0, "current": 1.5}, id="long stroke"),
    pytest.param({"angle_low": -4.0, "current_lag": 0.002}, id="short stroke, lagging"),
    pytest.param({"envelope": "coasting", "angle_margin": 0.9}, id="coasting"),
    pytest.param({"envelope": "coasting", "angle_margin": 0.9, "velocity": 120.0}, id="coasting, slow"),
    pytest.param({"envelope": "coasting", "angle_margin": 0.9, "angle_high": 10.0}, id="coasting, low"),
]


def drawn_bench(rng: Random) -> Bench:
    """A bench near the shipped one in which no two numbers agree."""
    low, high = SHIPPED.brake, SHIPPED.brake
    spread = rng.uniform(0.02, 0.1)
    narrow = {n: getattr(low, n) * rng.uniform(1.0 - 2.0 * spread, 1.0 - spread) for n in PARAMETER_NAMES}
    wide = {n: getattr(high, n) * rng.uniform(1.0 + spread, 1.0 + 2.0 * spread) for n in PARAMETER_NAMES}
    wide["J"], narrow["J"] = low.J * rng.uniform(1.01, 1.05), low.J * rng.uniform(0.95, 0.99)
    wide["gamma"], narrow["gamma"] = low.gamma * rng.uniform(1.01, 1.05), low.gamma * rng.uniform(0.95, 0.99)
    settings: dict[str, Any] = {
        "ranges": "drawn",
        "angle_margin": rng.uniform(0.25, 0.35),
        "break_away": rng.uniform(1.05, 1.2),
        "f_l": rng.uniform(1e-7, 1e-6),
        "noise_sigmas": rng.uniform(4.0, 6.0),
        "home_angle": rng.uniform(0.4, 0.6),
        "home_velocity": rng.uniform(4.0, 6.0),
    }
    return replace(
        SHIPPED,
        ranges={"drawn": Ranges("drawn", low._replace(**narrow), high._replace(**wide))},
        limits=Limits(
            rng.uniform(5.0, 6.0), (-rng.uniform(8.0, 10.0), rng.uniform(80.0, 100.0)), rng.uniform(450, 500)
        ),
        noise=Noise(rng.uniform(5e-4, 1e-3), rng.uniform(0.5, 1.0)),
        shield=SHIPPED.shield._replace(**settings),
        node=replace(SHIPPED.node, damping_velocity=rng.uniform(55.0, 65.0)),
    )


def behind(scaled: float, begun: float) -> float:
    """Samples by which an observer lags for what acted so many samples ago or before: it overshoots as well.

    Simpson's rule over the share of a change that a critically damped observer does not show yet.
    """
    n, end = 16000, 60.0
    h = (end - scaled * begun) / n
    weights = [(4.0 if i % 2 else 2.0) * (1.0 if 0 < i < n else 0.5) for i in range(n + 1)]
    at = [scaled * begun + i * h for i in range(n + 1)]
    missing = h / 3.0 * sum(w * (1.0 + s) * math.exp(-s) for w, s in zip(weights, at, strict=True))
    return missing / scaled + max(0.125 / scaled, 0.125 / 1.5)


def defined(bench: Bench) -> dict[str, float]:
    """The numbers of a bench's law, by their definitions."""
    brakes, limits, settings = bench.ranges["drawn"], bench.limits, bench.shield
    low, high = brakes.low, brakes.high
    ts, current, lag = bench.timing.sample_time, limits.current, settings.current_lag
    coasting = settings.envelope == "coasting"
    observer = min((bench.sensors.observer_bandwidth or 0.0) * ts, 3.0)
    late = settings.frame_age[1] > 0 or lag > 0.0
    bottom, top = limits.angle[0] + settings.angle_margin, limits.angle[1] - settings.angle_margin
    noise = settings.noise_sigmas * bench.noise.velocity
    motor = [low.k_m / high.J, high.k_m / low.J]
    spring = [low.gamma * low.k_1 / high.J, high.gamma * high.k_1 / low.J]
    static = settings.break_away * high.T_c + settings.f_l * high.k_1 * limits.angle[1]
    friction = [low.T_c / high.J, static / low.J]
    viscous = [low.f_v / high.J, high.f_v / low.J]
    braking = [current * m + friction[0] for m in motor]

    def homeward(motor: float, braking: float) -> float:
        """Speed from which a brake that enters the free stroke stops above the bottom, its lag included."""
        fastest = braking * (math.sqrt((1.5 * ts) ** 2 - 2.0 * bottom / braking) - 1.5 * ts)
        return fastest - lag * motor * current

    outward = limits.velocity - PAD
    home = min(outward, homeward(motor[0], braking[0]), homeward(motor[1], braking[1]))
    samples = settings.frame_age[1] + 1
    uneven = PAD + ts * (motor[1] / motor[0] * friction[1] - friction[0])
    creep = noise + samples * uneven
    apex = top
    if coasting:
        home = min(home, math.sqrt(-2.0 * friction[0] * bottom))
        # T_c/J (apex + stroke) = ½ w apex² + ½ v²: friction takes what the spring and the creep give.
        a, b, c = 0.5 * spring[1], -friction[0], 0.5 * (3.0 * creep) ** 2 + friction[0] * bottom
        apex = min(apex, (-b + math.sqrt(b * b - 4.0 * a * c)) / (2.0 * a))
    change = PAD + ts * (current * motor[1] + friction[1] + viscous[1] * limits.velocity + spring[1] * apex)
    seen = samples + (2.0 / observer if observer else 0.0)
    if observer:
        creep += 2.0 / observer * uneven + behind(observer, 5 - settings.frame_age[1]) * change
    cruise = (home - creep) / (1.0 + seen * ts * (motor[1] / motor[0] * viscous[1] - viscous[0]))
    share, gain, reserve = (0.5, 0.283, 25) if late else (0.65, 0.5, 2) if observer else (0.8, 0.6, 7)
    rest = noise + settings.home_velocity
    coast = (rest + noise) / friction[0]
    kept = coast + reserve * ts + 2.0 * lag + (12.0 * ts / observer if observer else 0.0)
    return {
        "sample_time": ts,
        "steps": bench.timing.horizon,
        "age_low": settings.frame_age[0],
        "age_high": settings.frame_age[1],
        "current": current,
        "angle_noise": settings.noise_sigmas * bench.noise.angle,
        "velocity_noise": noise,
        "bottom": bottom,
        "top": top,
        "outward_speed": outward,
        "homeward_speed": home,
        "reach": ts * limits.velocity,
        "motor_low": motor[0],
        "motor_high": motor[1],
        "spring_low": spring[0],
        "spring_high": spring[1],
        "friction_low": friction[0],
        "friction_high": friction[1],
        "viscous_low": viscous[0],
        "viscous_high": viscous[1],
        "braking": braking[0],
        "braking_high": braking[1],
        "damping_velocity": bench.node.damping_velocity,
        "change": change,
        "lag": lag,
        "kept": math.exp(-ts / lag) if lag else 0.0,
        "observer": observer,
        "coasting": coasting,
        "apex": apex,
        "creep": creep,
        "cruise": cruise,
        "ramp": current * motor[0] - friction[1] - 0.6 * viscous[1] * cruise,
        "landing": share * (braking[0] - spring[1] * min(cruise**2 / braking[0] / 2.0, 12.0)),
        "gain": gain,
        "reserve": kept,
        "committed": kept + 16 * ts,
        "settling": coast,
        "rest_zone": 0.3 * settings.home_angle,
        "settled_zone": 0.8 * settings.home_angle,
        "rest_velocity": rest,
    }


@pytest.mark.parametrize("kind", KINDS)
def test_a_law_s_numbers_are_those_of_their_definitions(kind: dict[str, Any]) -> None:
    rng = Random(3)
    for _ in range(4):
        bench = taken(drawn_bench(rng), **kind)
        assert numbers(make_law(bench)) == pytest.approx(defined(bench), rel=1e-12)


# --- Refusals: just inside the inequality a law is made, just outside the bench is refused for it --------------------


def taken(bench: Bench, **changes: Any) -> Bench:
    """A bench with other numbers: of its limits, its shield, its node, or ``low_``/``high_`` of its brakes."""
    for name, value in changes.items():
        if name == "observer":
            bench = replace(bench, sensors=Sensors("observer", value))
        elif name in ("angle_low", "angle_high"):
            ends = (value, bench.limits.angle[1]) if name == "angle_low" else (bench.limits.angle[0], value)
            bench = replace(bench, limits=replace(bench.limits, angle=ends))
        elif name.startswith(("low_", "high_")):
            side, parameter = name.split("_", 1)
            drawn = bench.ranges["drawn"]
            drawn = replace(drawn, **{side: getattr(drawn, side)._replace(**{parameter: value})})
            bench = replace(bench, ranges={"drawn": drawn})
        else:
            part = next(p for p in ("limits", "shield", "node", "noise", "timing") if hasattr(getattr(bench, p), name))
            at = getattr(bench, part)
            changed: Any = at._replace(**{name: value}) if isinstance(at, Shield) else replace(at, **{name: value})
            bench = replace(bench, **{part: changed})
    return bench


def longest_lag(bench: Bench) -> float:
    return 2.0 * bench.timing.sample_time - bench.shield.current_lag


def slowest_observer(bench: Bench) -> float:
    assert bench.sensors.observer_bandwidth is not None
    return bench.sensors.observer_bandwidth * bench.timing.sample_time - 0.75


def least_speed(bench: Bench) -> float:
    law = defined(bench)
    return law["cruise"] - law["velocity_noise"]


def stroke(bench: Bench) -> float:
    """What friction takes in the free stroke, beyond what the slowest speed home needs: there is an apex."""
    law = defined(taken(bench, envelope="braking"))
    return -law["friction_low"] * law["bottom"] - 0.5 * (3.0 * law["creep"]) ** 2


def viscous_change(bench: Bench) -> float:
    law = defined(bench)
    farthest = law["apex"] if law["coasting"] else bench.limits.angle[1]
    change = law["braking"] + law["spring_low"] * farthest + law["viscous_high"] * bench.limits.velocity
    return PAD - 0.5 * law["sample_time"] ** 2 * law["viscous_high"] * change


def damping(bench: Bench) -> float:
    law = defined(bench)
    share = law["motor_high"] * law["current"] / law["damping_velocity"] + law["viscous_high"]
    return 1.0 - share * law["sample_time"]


def margin(bench: Bench) -> float:
    law = defined(bench)
    ts, d = law["sample_time"], law["friction_low"]
    needed = chatter_excess(d, law["friction_high"], ts) + 0.005
    if law["coasting"]:
        needed += coasting_excess(law["spring_high"], d, law["viscous_low"], -law["bottom"], ts)
        needed += ts * law["friction_high"] / (2.0 * law["viscous_low"])
    else:
        weak, strong = (
            damped_excess(law[m], d, law["current"], law["damping_velocity"], ts)
            + ts * law["lag"] * law[m] * law["current"]
            for m in ("motor_low", "motor_high")
        )
        needed += max(weak, strong) if law["lag"] else weak
    return bench.shield.angle_margin - needed


def spring(bench: Bench) -> float:
    law = defined(bench)
    share = min(1.0, law["homeward_speed"] / law["damping_velocity"])
    held = law["motor_low"] * law["current"] * share + law["friction_low"]
    return held + law["viscous_low"] * law["homeward_speed"] - law["spring_high"] * bench.limits.angle[1]


def ramp(bench: Bench) -> float:
    return defined(bench)["ramp"]


def landing(bench: Bench) -> float:
    return defined(bench)["landing"]


def between_the_limits(bench: Bench) -> float:
    law = defined(bench)
    ts, late = law["sample_time"], law["age_high"]
    spread = {n: law[f"{n}_high"] - law[f"{n}_low"] for n in ("motor", "viscous", "spring")}
    acceleration = law["current"] * spread["motor"] + law["friction_low"] + law["friction_high"]
    acceleration += spread["viscous"] * bench.limits.velocity + spread["spring"] * bench.limits.angle[1]
    width = 2.0 * law["velocity_noise"] + (late + 1) * (2.0 * PAD + ts * acceleration)
    if bench.sensors.observer_bandwidth is not None:
        width += 2.0 * (2.0 / law["observer"] + behind(law["observer"], 5 - late)) * law["change"]
    width += (4.0 * law["lag"] + 2.0 * ts * late) * law["motor_high"] * law["current"]
    braked = width**2 / (2.0 * law["braking"]) + ts * width * (late + 2)
    return law["top"] - law["bottom"] - 2.0 * (braked + law["angle_noise"])


COASTING = {"envelope": "coasting", "angle_margin": 0.9}
REFUSED = [
    pytest.param({}, "current_lag", 0.0, 5e-3, longest_lag, "at most, got 0.002 s", id="lag"),
    pytest.param({"angle_high": 3.0}, "velocity", 450.0, 6.0, least_speed, "no homeward speed", id="speed"),
    pytest.param(COASTING, "angle_low", -10.0, -0.95, stroke, "free stroke by friction alone", id="stroke"),
    pytest.param({}, "high_f_v", 3.2e-5, 9e-5, viscous_change, "viscous friction changes", id="viscous"),
    pytest.param(
        COASTING, "high_f_v", 3.2e-5, 9e-5, viscous_change, "viscous friction changes", id="viscous, coasting"
    ),
    pytest.param({"angle_margin": 0.9}, "damping_velocity", 60.0, 10.0, damping, "would reverse", id="damping"),
    pytest.param(COASTING, "damping_velocity", 60.0, 10.0, damping, "would reverse", id="damping, coasting"),
    pytest.param({}, "angle_margin", 0.3, 0.05, margin, "the damped stop needs", id="margin"),
    pytest.param({"current_lag": 2e-3}, "angle_margin", 0.3, 0.05, margin, "the damped stop needs", id="margin, lag"),
    pytest.param(COASTING, "angle_margin", 0.9, 0.1, margin, "a brake that coasts in samples", id="margin, coasting"),
    pytest.param({}, "high_k_1", 28.0, 90.0, spring, "stiffest spring", id="spring"),
    pytest.param({"velocity": 50.0}, "high_k_1", 28.0, 90.0, spring, "stiffest spring", id="spring, slow"),
    pytest.param({"angle_margin": 0.9}, "high_T_c", 1.2e-2, 2e-1, ramp, "greatest friction", id="ramp"),
    pytest.param({"angle_high": 2.0}, "high_k_1", 28.0, 2e3, landing, "greatest friction", id="landing"),
    pytest.param({"frame_age": (0, 5)}, "angle_high", 90.0, -5.0, between_the_limits, "between the angle", id="room"),
    pytest.param({"current_lag": 2e-3}, "angle_high", 90.0, -8.0, between_the_limits, "between", id="room, lag"),
    pytest.param({"observer": 800.0}, "angle_high", 90.0, -6.5, between_the_limits, "between", id="room, observer"),
    pytest.param(
        {"observer": 800.0, "frame_age": (1, 1)}, "angle_high", 90.0, -6.0, between_the_limits, "between", id="room, 2"
    ),
    pytest.param({}, "observer", 1e3, 3e2, slowest_observer, "of 750 rad/s at least", id="observer"),
]


@pytest.mark.parametrize(("kind", "name", "good", "bad", "slack", "reason"), REFUSED)
def test_a_bench_is_refused_exactly_beyond_the_inequality_that_it_breaks(
    kind: dict[str, Any], name: str, good: float, bad: float, slack: Callable[[Bench], float], reason: str
) -> None:
    bench = taken(drawn_bench(Random(5)), **kind)
    inside, outside = good, bad
    assert slack(taken(bench, **{name: inside})) > 0.0 > slack(taken(bench, **{name: outside}))
    while abs(outside - inside) > 1e-9 * abs(good - bad):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if slack(taken(bench, **{name: middle})) > 0.0 else (inside, middle)
    make_law(taken(bench, **{name: inside}))
    with pytest.raises(BenchFileError, match=reason):
        make_law(taken(bench, **{name: outside}))


def test_without_a_damped_stop_a_coasting_bench_may_damp_as_it_likes() -> None:
    bench = taken(drawn_bench(Random(5)), **COASTING, damping_velocity=5.0)
    with pytest.raises(BenchFileError, match="would reverse"):
        make_law(bench)
    make_law(replace(bench, node=replace(bench.node, stop="freewheel")))
    with pytest.raises(BenchFileError, match="would reverse"):
        make_law(taken(bench, envelope="braking", stop="freewheel"))


@pytest.mark.parametrize("lag", [0.0, 1e-3])
@pytest.mark.parametrize("late", [0, 1])
@pytest.mark.parametrize("envelope", ["braking", "coasting"])
def test_a_lag_late_frames_and_coasting_are_covered_one_at_a_time(lag: float, late: int, envelope: str) -> None:
    bench = taken(drawn_bench(Random(5)), current_lag=lag, frame_age=(0, late), envelope=envelope, angle_margin=0.9)
    if (lag > 0.0) + late + (envelope == "coasting") <= 1:
        make_law(bench)
        return
    with pytest.raises(BenchFileError, match="are covered one at a time"):
        make_law(bench)


def test_an_observer_that_is_too_slow_is_told_as_a_bandwidth_and_as_a_lag() -> None:
    bench = taken(drawn_bench(Random(5)), observer=450.0)
    ts = bench.timing.sample_time
    least = f"{0.75 / ts:g} rad/s at least, or a sensors.velocity_lag of {0.9 * ts / 0.75:g} s at most"
    with pytest.raises(BenchFileError, match=f"{least}, got 450 rad/s, or 0.002 s;"):
        make_law(bench)


@pytest.mark.parametrize(
    "beside", [{"current_lag": 1e-3}, {"frame_age": (0, 2)}, {"envelope": "coasting", "angle_margin": 0.9}]
)
def test_an_observer_is_covered_with_frames_of_one_sample_and_nothing_else(beside: dict[str, Any]) -> None:
    bench = taken(drawn_bench(Random(5)), observer=1500.0)
    make_law(taken(bench, frame_age=(1, 1)))
    make_law(taken(bench, observer=750.0))
    with pytest.raises(BenchFileError, match=r"with frames of age 1 at most, .* or delete \[sensors\] where a sensor"):
        make_law(taken(bench, **beside))


@pytest.mark.parametrize("scaled", [0.3, 1.5, 1.6, 3.0])
def test_what_an_observer_lags_by_is_the_integral_of_what_it_does_not_show(scaled: float) -> None:
    for periods in range(6):
        assert unseen(scaled, periods) == pytest.approx(behind(scaled, periods), rel=1e-6)
    rests = [behind(scaled, i) for i in range(6)]
    hidden = hidden_by(scaled)
    assert hidden.before == pytest.approx(rests[::-1], rel=1e-6)
    assert hidden.periods == pytest.approx([a - b for a, b in itertools.pairwise(rests)], abs=1e-6)


def test_a_sensor_of_the_velocity_hides_nothing() -> None:
    assert make_law(SENSOR_BENCH).delay.hidden == ((0.0,) * 5, (0.0,) * 6)
    observed = make_law(taken(SENSOR_BENCH, observer=900.0)).delay
    assert observed.hidden == hidden_by(observed.observer)


def missing(damping: float, step: float, n: int) -> NDArray[np.float64]:
    """Share of a step of velocity that a tracking loop does not show after 0 to n of its samples.

    Its poles are those of damping and bandwidth; ``step`` is bandwidth times its sample time.
    """
    pole = np.exp(step * complex(-damping, math.sqrt(1.0 - damping**2)))
    a, b = 2.0 * pole.real, -(abs(pole) ** 2)
    shown = [0.0, 1.0 - a - b]
    for _ in range(n - 1):
        shown.append(a * shown[-1] + b * (shown[-2] if len(shown) > 2 else 0.0) + 1.0 - a - b)
    return 1.0 - np.array(shown)


@pytest.mark.parametrize("parts", [1, 2, 5, 40])
def test_every_observer_of_that_damping_and_at_least_that_bandwidth_is_among_those_assumed(parts: int) -> None:
    """Sampled once or more often a sample: it lags by no more in any sample, up to the share for what overshoots."""
    fine, n = 40, 60
    for damping, scaled in itertools.product(np.linspace(0.7, 1.0, 7), [*np.linspace(0.5, 6.0, 56), 10.0, 40.0]):
        nodes = missing(damping, scaled / parts, n * parts)
        share = np.interp(np.arange(n * fine + 1) / fine * parts, np.arange(n * parts + 1), nodes)
        assert_assumed(share, fine, scaled)
        assert_assumed(share, fine, 0.9 / float(np.trapezoid(share, dx=1.0 / fine)))  # declared by its lag alone


def assert_assumed(share: NDArray[np.float64], fine: int, scaled: float) -> None:
    """What is not shown, ``fine`` values a sample, is in each sample what the law assumes of a bandwidth.

    Up to the share for what overshoots. ``scaled`` is the bandwidth that is declared, times the sample time.
    """
    middles = 0.5 * (share[1:] + share[:-1]).reshape(-1, fine)
    declared = min(scaled, 3.0)
    most = [unseen(declared, i) - unseen(declared, i + 1) for i in range(len(middles))]
    beyond = np.maximum(np.maximum(middles, 0.0).sum(axis=1) / fine - most, 0.0).sum()
    beyond += np.maximum(-middles, 0.0).sum() / fine
    assert beyond <= 0.125 / min(declared, 1.5), (scaled, beyond)


@pytest.mark.parametrize("lag", [0.2, 0.5, 0.9, 1.2])
def test_every_chain_of_delays_averages_and_low_passes_of_that_lag_is_among_those_assumed(lag: float) -> None:
    """Its response is a random delay's with a log-concave density; those that matter are truncated exponentials.

    Moving averages and difference quotients are even densities, low-passes exponential ones, and pure delays points.
    """
    fine = 100
    after = np.arange(60 * fine + 1) / fine
    for first, rate in itertools.product(
        [0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0], [-30.0, -8.0, -2.0, 1e-6, 2.0, 8.0, 30.0]
    ):
        mean = first + 1.0 / rate - 1.0 / math.expm1(rate)  # of the density exp(-rate τ) in a width of 1
        inside = np.clip(after * mean / lag - first, 0.0, 1.0)
        assert_assumed(1.0 - np.expm1(-rate * inside) / math.expm1(-rate), fine, 0.9 / lag)


@pytest.mark.parametrize("kept", [0.0, 0.2, 0.41])
def test_a_low_passed_difference_quotient_is_among_those_assumed_of_its_lag(kept: float) -> None:
    """In samples: v̂ keeps a share of itself, and takes the rest of the newest quotient."""
    fine, n = 40, 60
    nodes = kept ** np.arange(n + 1.0)
    share = np.interp(np.arange(n * fine + 1) / fine, np.arange(n + 1), nodes)
    lag = float(np.trapezoid(share, dx=1.0 / fine))
    assert lag == pytest.approx(0.5 + kept / (1.0 - kept))
    assert_assumed(share, fine, 0.9 / lag)


def test_a_margin_of_just_what_is_needed_is_enough() -> None:
    law = make_law(SHIPPED)
    needed = chatter_excess(law.box.friction_low, law.box.friction_high, law.sample_time) + 0.005
    needed += damped_excess(law.box.motor_low, law.box.friction_low, law.current, law.damping_velocity, law.sample_time)
    make_law(taken(SHIPPED, angle_margin=needed))


def test_a_bench_of_one_brake_and_hardly_any_stroke_has_a_law_too() -> None:
    bench = drawn_bench(Random(5))
    bench = replace(bench, ranges={"drawn": Ranges("drawn", SHIPPED.brake, SHIPPED.brake)}, noise=Noise(1e-4, 1e-3))
    bench = taken(bench, break_away=1.0, f_l=0.0, angle_low=-bench.shield.angle_margin - 0.0012, angle_high=5.0)
    law = make_law(bench)
    assert law.homeward_speed < 1.0
    assert numbers(law) == pytest.approx(defined(bench), rel=1e-9)


@pytest.mark.parametrize(("angle_high", "apex"), [(0.5, False), (0.9, False), (1.5, True)])
def test_a_coasting_bench_needs_an_apex_beyond_the_origin(angle_high: float, apex: bool) -> None:
    bench = taken(drawn_bench(Random(5)), **COASTING, angle_high=angle_high)
    if apex:
        assert 0.0 < make_law(bench).home.apex < 1.0
        return
    with pytest.raises(BenchFileError, match="from no angle would a brake come to rest"):
        make_law(bench)


def test_a_coasting_bench_needs_no_motor_against_the_spring_and_no_room_for_full_braking() -> None:
    bench = taken(drawn_bench(Random(5)), **COASTING)
    make_law(taken(bench, damping_velocity=5000.0))
    wide = taken(bench, angle_high=3.0)
    make_law(replace(wide, noise=replace(wide.noise, angle=2.0)))


def test_a_coasting_bench_without_any_stroke_is_refused_for_that() -> None:
    with pytest.raises(BenchFileError, match="free stroke by friction alone"):
        make_law(taken(drawn_bench(Random(5)), **COASTING, angle_low=-0.5))


# --- What a stop needs beyond the envelope --------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(10))
def test_the_stoppable_velocity_is_the_greatest_whose_way_the_room_allows(seed: int) -> None:
    rng = Random(seed)
    for _ in range(30):
        braking, ts, before = rng.uniform(5e3, 3e4), rng.uniform(0.5e-3, 2e-3), rng.uniform(-100.0, 500.0)
        room = rng.choice([rng.uniform(0.0, 0.5), rng.uniform(0.0, 20.0), rng.uniform(-2.0, 0.0)])

        def way(v: float, a: float = braking, ts: float = ts, before: float = before) -> float:
            return v * v / (2.0 * a) + 0.5 * v * ts + ts * max(v, before)

        v = stoppable(room, before, braking, ts)
        if way(0.0) >= room:
            assert v == -1.0
        else:
            assert way(v) == pytest.approx(room, rel=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_where_the_current_lags_in_a_short_stroke_the_strongest_brake_limits_the_speed(seed: int) -> None:
    bench = taken(drawn_bench(Random(seed)), angle_low=-0.45, current_lag=2e-3)
    law, expected = law_of(bench), defined(bench)
    assert law.homeward_speed == pytest.approx(expected["homeward_speed"], rel=1e-9)
    weakest = law_of(taken(bench, high_k_m=bench.ranges["drawn"].low.k_m))
    assert law.homeward_speed < weakest.homeward_speed - 1.0


def test_no_velocity_is_stoppable_in_a_room_that_this_sample_uses_up() -> None:
    assert stoppable(0.0, -5.0, 1e4, 1e-3) == -1.0
    assert stoppable(1e-3 * 40.0, 40.0, 1e4, 1e-3) == -1.0
    assert 0.0 < stoppable(math.nextafter(1e-3 * 40.0, 1.0), 40.0, 1e4, 1e-3) < 1e-6


def test_the_damped_excess_is_the_difference_of_two_ways_counted_in_small_steps() -> None:
    motor, friction, current, slow, ts = 2500.0, 1200.0, 5.0, 70.0, 2e-3
    dt, damped, full, v, w = 1e-6, 0.0, 0.0, slow, slow
    while v > 0.0:
        damped += v * dt
        v -= dt * (motor * current * v / slow + friction)
    while w > 0.0:
        full += w * dt
        w -= dt * (motor * current + friction)
    expected = damped + slow * ts - (full + 0.5 * slow * ts)
    assert damped_excess(motor, friction, current, slow, ts) == pytest.approx(expected, rel=1e-3)


def test_the_chatter_excess_is_a_stop_and_the_alternating_steps_from_the_speed_that_friction_throws_to() -> None:
    assert chatter_excess(1000.0, 3000.0, 1e-3) == pytest.approx(3.0**2 / 2000.0 + 3.0e-3 + 2.0 * 3.0e-3)


def test_the_coasting_excess_is_the_euler_energy_over_friction() -> None:
    spring, friction, viscous, free, ts = 140.0, 1100.0, 3.0, 9.7, 1e-3
    # The apex: friction · (x + free) = ½ spring x²; home it is pulled with spring · x + friction at most.
    apex = (friction + math.sqrt(friction**2 + 2.0 * spring * friction * free)) / spring
    fastest = spring * apex + friction
    # ½ ts a² = (viscous − ½ ts spring) v²: below this speed Euler gains energy.
    slow = fastest * math.sqrt(0.5 * ts / (viscous - 0.5 * ts * spring))
    gained = 0.5 * ts * slow * (fastest + fastest + friction)
    assert coasting_excess(spring, friction, viscous, free, ts) == pytest.approx(gained / friction)
    assert coasting_excess(spring, friction, 0.5 * ts * spring, free, ts) == math.inf
    assert coasting_excess(spring, friction, 0.5 * ts * spring + 0.01, free, ts) == pytest.approx(
        gained / friction * (2.93 / 0.01) ** 0.5
    )


def test_a_refusal_names_the_largest_whole_angle_that_the_shield_could_hold_if_there_is_one() -> None:
    bench = SENSOR_BENCH

    def refusal(current: float, top: float) -> str:
        limits = dataclasses.replace(bench.limits, current=current, angle=(bench.limits.angle[0], top))
        try:
            make_law(dataclasses.replace(bench, limits=limits))
        except BenchFileError as err:
            return str(err)
        return ""

    for current, angle in ((5.0, 98), (4.0, 81), (3.0, 63)):
        for top in (100.0, angle + 1.0, angle + 0.99):
            assert refusal(current, top).endswith(f"; narrow k_m or k_1, or lower limits.angle to {angle} rad")
        assert refusal(current, angle) == ""
    assert refusal(1.0, 100.0).endswith("; narrow k_m or k_1")


@pytest.mark.parametrize(
    ("steps", "settling", "sample_time", "late"),
    [(500, 0.015, 1e-3, 483), (500, 0.0152, 1e-3, 482), (100, 0.0, 1e-3, 98), (500, 0.016, 4e-3, 494)],
)
def test_a_way_home_is_always_two_samples_and_the_settling_time_before_its_end(
    steps: int, settling: float, sample_time: float, late: int
) -> None:
    law = with_numbers(make_law(SENSOR_BENCH), steps=steps, settling=settling, sample_time=sample_time)
    assert late_step(law) == late
