"""The proof of the response against the formulas of ``docs/explanation/sensor-monitor.md``, for samples at random.

The reference is written from the page, in matrices. A model's numbers are drawn independently of each other, so that
none can stand in for another; velocities and currents often lie exactly at its thresholds.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from random import Random

import numpy as np
import pytest

from emb_runtime.can.e2e import COUNTER_MODULUS
from emb_runtime.config.bench import Sensors
from emb_runtime.records import NodeState, SensorSample
from emb_runtime.safety.response import (
    CONTRADICTED,
    OPEN,
    PROVEN,
    Response,
    ResponseModel,
    Row,
    State,
    begin_response,
    overshoot,
    response_model,
    take,
    unproven_law,
)
from emb_runtime.safety.shield_design import ShieldLaw, make_law
from emb_runtime.safety.state_machine import Fault, StopError
from tests.benches import SENSOR_BENCH
from tests.laws import numbers, with_numbers

BENCH = SENSOR_BENCH
SHIPPED = make_law(BENCH)
UPPER = np.triu_indices(6)


class Reference:
    """The filter and the verdict of the page."""

    def __init__(self, model: ResponseModel, angle: float, velocity: float) -> None:
        self.model, self.angle, self.velocity = model, angle, velocity
        self.x = np.array([velocity, *model.prior, 0.0])
        self.p = np.diag(np.square([model.deviation, *model.deviations, model.widest]))
        self.commands = [0.0] * 6
        self.lagging = self.unseen = self.largest = self.doubts = self.slid = 0.0
        self.misfit = self.likelihood = self.count = 0.0

    def take(self, follows: bool, angle: float, velocity: float, command: float) -> int:
        m, ts = self.model, self.model.sample_time
        self.commands = [command, *self.commands[:5]]
        u, before = self.commands[m.age], self.unseen
        self.unseen = self.mean_of_unseen()
        immediate = m.oldest == m.age and not m.lag
        transient = m.transient * m.box.motor_high * max(abs(u - c) for c in (self.unseen, *self.commands[m.age :]))
        self.largest = max(self.largest, abs(self.unseen))
        speeds = self.velocity, velocity
        drive, way, noise = self.driven(u, u if immediate else before, transient, speeds)
        if way and min(map(abs, speeds)) > m.slides:
            self.slid += 1.0
        if not follows:
            self.doubts, self.slid = m.doubts, -4.0
        if self.doubts > 0.0:
            self.doubts, noise = self.doubts - 1.0, noise + 3.0 * m.change
        moves = float(bool(drive or way))
        pressed = moves * (max(self.angle, 0.0) + max(angle, 0.0)) / 2.0
        transition = np.eye(6)
        transition[0, 1:5] = ts * np.array([drive, -way, -pressed, -moves * sum(speeds) / 2.0])
        self.x = transition @ self.x
        self.p = transition @ self.p @ transition.T
        self.p[0, 0] += noise**2
        measures = np.array([1.0, 0.0, 0.0, 0.0, 0.0, -self.unseen / m.current])
        least = m.deviation**2 + transient**2
        variance = max(measures @ self.p @ measures + least, least)
        gain, innovation = self.p @ measures / variance, velocity - measures @ self.x
        self.x = self.x + gain * innovation
        self.p = self.p - np.outer(gain, gain) * variance
        self.count += 1.0
        self.misfit += innovation**2 / variance
        self.likelihood += innovation**2 / variance + math.log(variance)
        self.angle, self.velocity = angle, velocity
        return self.verdict()

    def mean_of_unseen(self) -> float:
        m, ts = self.model, self.model.sample_time
        oldest = self.commands[m.oldest]
        if m.lag:
            self.lagging = oldest + math.exp(-ts / m.lag) * (self.lagging - oldest)
        currents = [*self.commands[m.age : m.oldest], self.lagging]
        times = [ts] * (m.oldest - m.age) + [m.lag]
        return float(np.average(currents, weights=times)) if sum(times) else self.commands[m.age]

    def driven(self, u: float, before: float, transient: float, speeds: tuple[float, float]) -> tuple[float, ...]:
        """Current, direction of friction, deviation of what they do."""
        m = self.model
        for way in (1.0, -1.0):
            if all(way * v > m.slides for v in speeds):
                return u, way, 0.0
        friction = m.sample_time * m.box.friction_high
        pushed = math.copysign(1.0, u) if u else -1.0
        if any(pushed * v < -m.slides for v in speeds):
            return u, 0.0, friction + transient
        if abs(u) <= m.holds and abs(before) <= m.holds:
            return 0.0, 0.0, transient
        if pushed * u >= m.moves and pushed * before >= m.moves:
            return u, pushed, 0.0
        return u / 2.0, 0.0, friction + m.sample_time * m.box.motor_high * abs(u) / 2.0 + transient

    def beyond(self, response: float) -> tuple[float, float]:
        share = np.array([0.0, -self.model.current * response, 0.0, 0.0, 0.0, 1.0])
        return share @ self.x, math.sqrt(max(share @ self.p @ share, 0.0))

    def verdict(self) -> int:
        m, n, applied = self.model, self.model.slides, self.largest / self.model.current
        late, late_error = self.beyond(1.1 * m.extra)
        early, early_error = self.beyond(-m.early)
        if applied * (late - 4.5 * late_error) > n / 2.0 or applied * (early + 4.5 * early_error) < -n / 2.0:
            return CONTRADICTED
        motor = 0.9 * m.box.motor_low < self.x[1] < 1.1 * m.box.motor_high
        at_once, error = self.beyond(0.0)
        bounded = late + 3.0 * late_error < n and (m.age == 0 or at_once - 3.0 * error > -n)
        return PROVEN if motor and bounded and self.slid >= 2.0 and self.misfit <= 3.0 * self.count else OPEN


def drawn_law(dice: Random) -> ShieldLaw:
    low = dice.randrange(3)
    f = dice.uniform
    return with_numbers(
        SHIPPED, sample_time=f(5e-4, 2e-3), current=f(3.0, 9.0), age_low=low, age_high=low + dice.choice((0, 0, 1, 3)),
        lag=dice.choice((0.0, 0.0, f(5e-4, 3e-3))), velocity_noise=f(4.0, 9.0), change=f(20.0, 80.0),
        motor_low=f(2000.0, 3000.0), motor_high=f(5000.0, 8000.0), friction_low=f(500.0, 1500.0),
        friction_high=f(2000.0, 4000.0), spring_low=f(20.0, 40.0), spring_high=f(60.0, 120.0),
        viscous_low=f(1.0, 3.0), viscous_high=f(5.0, 9.0),
    )  # fmt: skip


def test_the_model_is_that_of_the_page() -> None:
    for seed in range(20):
        dice = Random(seed)
        law = drawn_law(dice)
        bandwidth = dice.choice((None, dice.uniform(800.0, 3000.0)))
        noise = dice.choice((0.1, dice.uniform(0.5, 3.0)))
        sensors = Sensors("observer", bandwidth) if bandwidth else BENCH.sensors
        bench = replace(BENCH, sensors=sensors, noise=replace(BENCH.noise, velocity=noise))
        model, t = response_model(bench, law), law.sample_time
        sample = law.box.motor_high * law.current * t  # what the strongest motor adds in one
        frames = (law.age_high - law.age_low) * t
        lag = law.delay.lag + (2.0 / bandwidth if bandwidth else 0.0)
        of = numbers(law)
        bounds = [(of[f"{n}_low"], of[f"{n}_high"]) for n in ("motor", "friction", "spring", "viscous")]
        assert model == ResponseModel(
            sample_time=t,
            current=law.current,
            age=law.age_low,
            oldest=law.age_high,
            lag=pytest.approx(lag, rel=1e-9, abs=0.0),  # type: ignore[arg-type]
            extra=pytest.approx(frames + lag, rel=1e-12),  # type: ignore[arg-type]
            transient=pytest.approx(0.35 * frames + 0.2 * lag, rel=1e-9),  # type: ignore[arg-type]
            doubts=1 + law.age_high + math.ceil(3 * (frames + lag) / t),
            early=pytest.approx((0.7 if law.age_low else 6.0) * t),  # type: ignore[arg-type]
            deviation=pytest.approx(max(noise, 0.02 * sample)),  # type: ignore[arg-type]
            slides=pytest.approx(max(law.velocity_noise, 6.0 * max(noise, 0.02 * sample))),  # type: ignore[arg-type]
            holds=pytest.approx(law.box.friction_low / law.box.motor_high),  # type: ignore[arg-type]
            moves=pytest.approx(law.box.friction_high / law.box.motor_low),  # type: ignore[arg-type]
            change=law.change,
            box=law.box,
            prior=pytest.approx([np.mean(pair) for pair in bounds]),  # type: ignore[arg-type]
            deviations=pytest.approx([(b - a) / 12**0.5 for a, b in bounds]),  # type: ignore[arg-type]
            widest=pytest.approx(3.0 * sample),  # type: ignore[arg-type]
        )


def drawn_model(dice: Random) -> ResponseModel:
    model = response_model(BENCH, drawn_law(dice))
    f = dice.uniform
    return model._replace(
        transient=dice.choice((0.0, f(1e-4, 1e-3))), doubts=float(dice.randrange(1, 6)), early=f(5e-4, 6e-3),
        extra=dice.choice((0.0, f(1e-4, 5e-3))), deviation=f(0.5, 2.0), slides=float(dice.randrange(3, 9)),
        holds=0.25, moves=f(1.0, 1.5), widest=f(30.0, 150.0),
    )  # fmt: skip


def samples(dice: Random, model: ResponseModel) -> Iterator[Row]:
    """A brake of about the set that moves with the commands of some periods ago, and jumps now and then."""
    late, motor = dice.randrange(4), dice.uniform(0.8 * model.box.motor_low, 1.2 * model.box.motor_high)
    ts, commands, angle, velocity, command = model.sample_time, [0.0] * 6, dice.uniform(-1.0, 1.0), 0.0, 0.0
    levels = [0.0, 0.1, model.holds, model.moves, 0.7, 0.5 * model.current, model.current]
    exact = [model.slides, -model.slides, 0.0, 2.0, -2.0]
    steady, eventful = dice.choice((0.1, 0.3, 1.0)), dice.choice((0.0, 0.1, 0.4))
    for _ in range(40):
        if dice.random() < steady:
            command = dice.choice((1.0, -1.0)) * dice.choice(levels)
        commands = [command, *commands[:5]]
        velocity += ts * motor * commands[late] + dice.gauss(0.0, model.deviation)
        if abs(velocity) > 200.0 or dice.random() < 0.5 * eventful:
            velocity = dice.choice(exact) * dice.choice((1.0, 1.0, 1.5))
        angle += ts * velocity
        yield Row(dice.random() > 0.2 * eventful, angle, velocity, command)


def test_filter_and_verdicts_are_those_of_the_page() -> None:
    for seed in range(120):
        dice = Random(seed)
        model = drawn_model(dice)
        angle, velocity = dice.uniform(-2.0, 2.0), dice.uniform(-9.0, 9.0)
        state, reference = begin_response(model, angle, velocity), Reference(model, angle, velocity)
        for row in samples(dice, model):
            expected = reference.take(*row)
            state, found = take(model, state, *row)
            scale = np.sqrt(np.diag(reference.p))
            assert np.abs((np.array(state.mean) - reference.x) / scale).max() < 1e-5
            errors = (state.covariance - reference.p[UPPER]) / np.outer(scale, scale)[UPPER]
            assert np.abs(errors).max() < 1e-5
            sums = state.innovations, state.misfit, state.likelihood
            assert (state.slides, state.doubts) == (reference.slid, reference.doubts)
            assert state.largest == pytest.approx(reference.largest)
            assert sums == pytest.approx((reference.count, reference.misfit, reference.likelihood), rel=1e-6, abs=1e-6)
            assert found == expected, seed


def test_the_slow_law_is_that_of_the_page() -> None:
    for seed in range(20):
        dice = Random(seed)
        f, law = dice.uniform, drawn_law(dice)
        law = with_numbers(law, bottom=-f(2.0, 5.0), creep=f(1.0, 9.0), cruise=f(0.1, 0.9))
        law = with_numbers(law, outward_speed=f(50.0, 600.0), homeward_speed=f(50.0, 600.0))
        limit, bandwidth = dice.uniform(200.0, 900.0), dice.uniform(400.0, 4000.0)
        bench = replace(BENCH, sensors=Sensors("observer", bandwidth), limits=replace(BENCH.limits, velocity=limit))
        t = law.sample_time
        declared = (law.age_high - law.age_low) * t + law.delay.lag + 2.0 / bandwidth
        unknown = (6.0 - law.age_low) * t - declared
        fastest = max(limit - unknown * law.box.motor_high * law.current, 0.25 * law.homeward_speed)
        homeward = min(math.sqrt(0.5) * law.homeward_speed, fastest)
        slow = unproven_law(bench, law)
        assert slow.outward_speed == pytest.approx(min(law.outward_speed, fastest))
        assert slow.homeward_speed == pytest.approx(homeward)
        assert slow.bottom == 0.5 * law.bottom, seed
        home = law.home
        assert slow.home.cruise == pytest.approx(
            home.cruise * (homeward - home.creep) / (law.homeward_speed - home.creep)
        )
        same = {name: numbers(law)[name] for name in ("outward_speed", "homeward_speed", "bottom", "cruise")}
        assert with_numbers(slow, **same) == law


NEAT = response_model(BENCH, SHIPPED)._replace(
    sample_time=2.0**-10, current=8.0, extra=0.0, transient=0.0, early=0.0, deviation=1.0, slides=8.0,
    box=SHIPPED.box._replace(motor_low=1000.0, motor_high=2000.0),
)  # fmt: skip
EXACT: State = begin_response(NEAT._replace(deviation=0.0, deviations=(0.0, 0.0, 0.0, 0.0), widest=0.0), 0.0, 100.0)
KNOWN = {"overshoot": 0.0, "largest": 8.0, "motor": 1500.0, "slides": 1.0, "misfit": 0.0, "age": 0}


@pytest.mark.parametrize(
    ("known", "verdict"),
    [
        ({}, PROVEN),
        ({"overshoot": 4.0}, PROVEN),
        ({"overshoot": 4.001}, CONTRADICTED),
        ({"overshoot": -4.0}, PROVEN),
        ({"overshoot": -4.001}, CONTRADICTED),
        ({"overshoot": 7.999, "largest": 4.0}, PROVEN),
        ({"overshoot": 8.0, "largest": 4.0}, OPEN),
        ({"overshoot": 8.001, "largest": 4.0}, CONTRADICTED),
        ({"overshoot": -8.0, "largest": 4.0}, PROVEN),
        ({"overshoot": -7.999, "largest": 4.0, "age": 1}, PROVEN),
        ({"overshoot": -8.0, "largest": 4.0, "age": 1}, OPEN),
        ({"overshoot": -8.001, "largest": 4.0}, CONTRADICTED),
        ({"motor": 900.0}, OPEN),
        ({"motor": 901.0}, PROVEN),
        ({"motor": 2199.0}, PROVEN),
        ({"motor": 2200.0}, OPEN),
        ({"slides": 0.0}, OPEN),
        ({"misfit": 12.0}, PROVEN),
        ({"misfit": 12.001}, OPEN),
        ({"overshoot": math.nan}, OPEN),
        ({"motor": math.nan}, OPEN),
        ({"misfit": math.nan}, OPEN),
    ],
)
def test_verdicts_at_their_thresholds_where_all_is_known_exactly(known: dict[str, float], verdict: int) -> None:
    are = KNOWN | known
    mean = 100.0, are["motor"], 0.0, 0.0, 0.0, are["overshoot"]
    state = EXACT._replace(
        mean=mean, largest=are["largest"], slides=are["slides"], innovations=3.0, misfit=are["misfit"]
    )
    model = NEAT._replace(age=int(are["age"]), oldest=int(are["age"]))
    assert take(model, state, True, 0.0, 100.0, 0.0)[1] == verdict


def test_a_variance_that_rounding_makes_negative_counts_as_none() -> None:
    state = EXACT._replace(mean=(100.0, 0.0, 0.0, 0.0, 0.0, 2.0), covariance=(-4.0, *EXACT.covariance[1:20], -1e-9))
    assert overshoot(NEAT, state, 0.0) == (2.0, 0.0)
    assert take(NEAT, state, True, 0.0, 101.0, 0.0)[0].misfit == 1.0  # of the measurement's variance alone


def sample(row: Row) -> SensorSample:
    return SensorSample(0, row.angle, row.velocity, 0, 0, row.command, 0, NodeState.ACTIVE)


def sliding(late: int, count: int = 80) -> list[Row]:
    """A nominal brake without noise, in the free stroke: twelve samples of 6 A, then friction."""
    p, v, x, rows = BENCH.brake, 0.0, 0.0, []
    for k in range(1, count):
        u = 6.0 if late < k < late + 12 else 0.0
        after = max(v + 1e-3 * (p.k_m * u - p.T_c * (v > 0.0 or u > 0.0)) / p.J, 0.0)
        x, v = x + 5e-4 * (v + after), after
        rows.append(Row(True, x, v, 6.0 if k < 12 else 0.0))
    return rows


def test_a_run_has_the_slow_law_until_its_response_is_proven_and_again_in_the_next_run() -> None:
    response, slow = Response(BENCH, SHIPPED), unproven_law(BENCH, SHIPPED)
    first = sample(Row(False, 0.0, 0.0, 0.0))
    assert (response.law, response.rows, response.proven) == (slow, [], False)
    for _ in range(2):
        response.begin_run(first)
        assert (response.law, response.proven) == (slow, False)
        for row in sliding(0):
            if not response.proven:
                assert response.law == slow
                response.add_sample(sample(row), row.follows, row.command)
        assert response.proven
        assert response.law == SHIPPED
        assert response.rows == [Row(False, 0.0, 0.0, 0.0), *sliding(0)[: len(response.rows) - 1]]
        assert response.description.startswith("the velocity follows the commands with a delay of 0.0 ± 0.")
        assert response.description.endswith(" samples, at most 0 are declared")


def test_a_delay_that_is_negative_by_less_than_is_told_has_no_sign() -> None:
    response, dice = Response(BENCH, SHIPPED), Random(2)
    response.begin_run(sample(Row(False, 0.0, 0.0, 0.0)))
    for row in sliding(0)[:12]:
        response.add_sample(
            sample(row._replace(velocity=row.velocity + dice.gauss(0.0, 0.5))), row.follows, row.command
        )
    assert response.description.startswith("the velocity follows the commands with a delay of 0.0 ± 0.")


def told(text: str) -> tuple[float, float, float]:
    """Measured delay, its standard deviation and what is declared [samples]."""
    form = r"the velocity follows the commands with a delay of (\S+) ± (\S+) samples, at most (\S+) are declared"
    numbers = re.fullmatch(form, text)
    assert numbers is not None
    late, error, most = map(float, numbers.groups())
    return late, error, most


def test_a_late_response_ends_the_run_with_the_samples_that_show_it() -> None:
    response, rows = Response(BENCH, SHIPPED), sliding(2)
    response.begin_run(sample(Row(False, 0.0, 0.0, 0.0)))
    response.add_sample(sample(rows[0]), True, 6.0)
    response.add_sample(sample(rows[1]), True, 6.0)
    with pytest.raises(StopError) as stop:
        response.add_sample(sample(rows[2]), True, 6.0)
    assert (stop.value.fault, stop.value.detail) == (Fault.RESPONSE_LATE, response.description)
    assert told(response.description)[0] > 1.0
    assert response.law == unproven_law(BENCH, SHIPPED)
    assert response.rows == [Row(False, 0.0, 0.0, 0.0), *rows[:3]]


@pytest.mark.parametrize(("after", "least", "most"), [(9, 0.5, 2.0), (20, 0.0, 0.4)])
@pytest.mark.parametrize("late", [1, 2, 3])
def test_the_delay_that_is_told_is_known_once_the_current_has_changed(
    late: int, after: int, least: float, most: float
) -> None:
    bench = replace(BENCH, shield=BENCH.shield._replace(frame_age=(1, 3)))
    response = Response(bench, make_law(bench))
    response.begin_run(sample(Row(False, 0.0, 0.0, 0.0)))
    for row in sliding(late)[:after]:
        response.add_sample(sample(row), row.follows, row.command)
    found, error, declared = told(response.description)
    assert found == pytest.approx(late, abs=most)
    assert declared == 3.0
    assert least <= error < most


def test_once_proven_the_samples_are_only_kept() -> None:
    response = Response(BENCH, SHIPPED)
    response.begin_run(sample(Row(False, 0.0, 0.0, 0.0)))
    rows = iter(sliding(0))
    while not response.proven:
        response.add_sample(sample(row := next(rows)), row.follows, row.command)
    told, still = response.description, Row(True, 1.0, 0.0, 6.0)
    for _ in range(20):
        response.add_sample(sample(still), True, 6.0)
    assert (response.proven, response.description, response.rows[-1]) == (True, told, still)


def test_the_newest_samples_of_a_run_and_the_first_of_its_stop_are_kept() -> None:
    response = Response(BENCH, SHIPPED)
    response.begin_run(sample(Row(False, 0.0, 0.0, 0.0)))
    for k in range(80):
        row = Row(True, 1e-3 * k, 0.0, 0.0)
        response.add_sample(sample(row)._replace(counter=4), True, 0.0)
        assert len(response.rows) == min(k + 2, 32)
        assert response.rows[-1] == row
    rows = []
    for k in range(80):
        rows.append(Row(k != 7, 1e-3 * k, 2e-3 * k, 0.5))  # a sample is lost before the eighth
        counter = (5 + k + (k >= 7)) % COUNTER_MODULUS
        response.watch(sample(rows[-1])._replace(counter=counter))
        assert response.stop == rows[:32]
