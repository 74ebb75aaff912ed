"""Delays, offset, jitter and the observer, against closed forms and brute force; simulation in open loop."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_bench.config.bench import Bench, load_bench
from emb_bench.config.plants import LONGEST_DELAY, Instruments
from emb_bench.experiment.experiment import planned
from emb_bench.experiment.simulate import SystematicErrors, Theta, simulate, simulate_apart
from emb_bench.sim.instruments import MEMORY, Tracked, command, measure, observe, observer_noise, settle
from emb_bench.sim.open_loop import march
from emb_runtime.errors import UsageError
from emb_runtime.estimator.observer import DAMPING, observer_gains
from tests.bench.flows import ALL, square

T_S = 1e-3
finite = st.floats(-1e3, 1e3)


def memory_of(instruments: Instruments, angle: float = 0.0) -> Any:
    memory = np.full(MEMORY, math.nan)
    settle(instruments, memory, angle)
    return memory


def shown(instruments: Instruments, memory: Any, x1: float, x2: float = 0.0, a: float = 0.0, late: float = 0.0) -> Any:
    return measure(instruments, memory, T_S, x1, x2, a, late, 0.0, 0.0)


@given(st.tuples(finite, finite, finite), finite, finite)
def test_ideal_instruments_add_the_noise_and_nothing_else(
    motion: tuple[float, float, float], angle_error: float, velocity_error: float
) -> None:
    x1, x2, a = motion
    ideal = Instruments()
    memory = memory_of(ideal)
    assert measure(ideal, memory, T_S, x1, x2, a, 0.0, angle_error, velocity_error) == (
        x1 + angle_error,
        x2 + velocity_error,
    )
    assert command(ideal, memory, x1) == x1


@given(st.integers(0, LONGEST_DELAY), st.integers(0, LONGEST_DELAY), st.lists(finite, min_size=1, max_size=40))
def test_a_delay_of_n_samples_gives_what_was_n_samples_ago_and_rest_before_that(
    acts: int, sends: int, values: list[float]
) -> None:
    instruments = Instruments(command_delay=acts, measurement_delay=sends)
    memory = memory_of(instruments, 5.0)
    for k, value in enumerate(values):
        assert command(instruments, memory, value) == (values[k - acts] if k >= acts else 0.0)
        angle, velocity = shown(instruments, memory, value, -value)
        expected = (values[k - sends], -values[k - sends]) if k >= sends else (5.0, 0.0)
        assert (angle, velocity) == expected


def test_the_encoder_shows_its_offset_at_the_origin() -> None:
    instruments = Instruments(encoder_offset=0.2, measurement_delay=1)
    memory = memory_of(instruments)
    assert [shown(instruments, memory, x)[0] for x in (0.0, 1.0, 2.0)] == [0.2, 0.2, 1.2]


@given(st.floats(-1e-3, 1e-3), st.floats(-500.0, 500.0), st.floats(-3e4, 3e4))
def test_a_sample_taken_late_shows_where_the_brake_is_by_then(late: float, x2: float, a: float) -> None:
    ideal = Instruments()
    angle, velocity = shown(ideal, memory_of(ideal), 1.0, x2, a, late)
    assert angle == pytest.approx(1.0 + x2 * late + 0.5 * a * late**2, abs=1e-12)
    assert velocity == pytest.approx(x2 + a * late, abs=1e-9)


@pytest.mark.parametrize("bandwidth", [10.0, 100.0, 300.0, 700.0, 1520.0, 3000.0, 6000.0])
def test_the_observer_has_the_poles_of_its_bandwidth_and_the_noise_of_its_lyapunov_equation(bandwidth: float) -> None:
    alpha, beta = observer_gains(bandwidth, T_S)
    transition = np.array([[1.0 - alpha, (1.0 - alpha) * T_S], [-beta / T_S, 1.0 - beta]])
    pole = np.exp((-DAMPING + 1j * math.sqrt(1.0 - DAMPING**2)) * bandwidth * T_S)
    assert np.poly(transition) == pytest.approx([1.0, -2.0 * pole.real, abs(pole) ** 2], rel=1e-9)
    entry = np.array([[alpha], [beta / T_S]])
    covariance = np.linalg.solve(np.eye(4) - np.kron(transition, transition), (entry @ entry.T).ravel())
    assert observer_noise(bandwidth, T_S, 2e-3) == pytest.approx(2e-3 * math.sqrt(covariance[3]), rel=1e-9)


def test_the_observer_of_the_shipped_bench_has_the_velocity_noise_of_the_shipped_bench(bench: Bench) -> None:
    instruments = bench.plant("observer").instruments
    stated = bench.noise.velocity
    derived = observer_noise(instruments.observer_bandwidth, bench.timing.sample_time, bench.noise.angle)
    assert derived == pytest.approx(stated, rel=1e-3)
    memory, generator = memory_of(instruments), np.random.default_rng(0)
    errors = bench.noise.angle * generator.standard_normal(40_000)
    velocities = [measure(instruments, memory, T_S, 0.0, 0.0, 0.0, 0.0, float(e), 1e9)[1] for e in errors]
    assert np.std(velocities) == pytest.approx(stated, rel=0.02)


@given(st.floats(50.0, 6000.0), st.floats(-500.0, 500.0))
def test_the_observer_s_velocity_is_right_at_constant_speed_and_lags_under_acceleration(
    bandwidth: float, speed: float
) -> None:
    instruments = Instruments(observer_bandwidth=bandwidth)
    settled = math.ceil(60.0 / (bandwidth * T_S))
    memory = memory_of(instruments)
    for k in range(settled):
        velocity = shown(instruments, memory, speed * k * T_S)[1]
    assert velocity == pytest.approx(speed, abs=1e-6 * (1.0 + abs(speed)))
    memory, a = memory_of(instruments), 1000.0
    for k in range(settled):
        velocity = shown(instruments, memory, 0.5 * a * (k * T_S) ** 2)[1]
    alpha, beta = observer_gains(bandwidth, T_S)
    assert a * (settled - 1) * T_S - velocity == pytest.approx(a * T_S * (alpha / beta - 0.5), rel=1e-3)


def test_the_observer_works_on_the_measured_angle_with_its_noise_offset_and_jitter() -> None:
    instruments = Instruments(observer_bandwidth=500.0, encoder_offset=0.3)
    memory, alone = memory_of(instruments), Tracked(0.3, 0.0)
    generator = np.random.default_rng(1)
    for k in range(50):
        error, late = (float(v) for v in 1e-3 * generator.standard_normal(2))
        angle, velocity = measure(instruments, memory, T_S, 0.1 * k, 100.0, 0.0, late, error, 7.0)
        assert angle == pytest.approx(0.1 * k + 100.0 * late + 0.3 + error)
        alone = observe(500.0, alone, T_S, angle)
        assert velocity == alone.velocity


BENCH = load_bench()
BRAKE = BENCH.brake
EULER = BENCH.plant("euler")
EXACT = BENCH.plant("exact")


def test_the_base_install_is_enough() -> None:
    ours = "emb_bench.information.fisher, emb_bench.excitation, emb_bench.sim.open_loop, emb_bench.compiled"
    code = f"import sys, {ours}; print(*sorted({{'numba', 'scipy', 'matplotlib', 'torch'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == ""


def test_states_do_not_depend_on_what_is_asked_about_them() -> None:
    for plant in (EULER, EXACT, BENCH.plant("rough")):
        theta, currents = Theta(BRAKE, (1.0, -20.0)), planned(square(20, 4.0))
        alone, asked = (simulate(plant, theta, currents, T_S, params) for params in ((), ALL))
        np.testing.assert_array_equal(alone.states, asked.states)
        assert alone.sensitivities.shape == (500, 0, 2)


@pytest.mark.parametrize(
    ("params", "message"), [(("k_m", "mass"), "'mass' is no parameter"), (("f_v", "f_v"), "comes twice")]
)
def test_parameters_that_make_no_sense_are_refused(params: tuple[str, ...], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        simulate(EULER, Theta(BRAKE), planned([1.0]), T_S, params)


@pytest.mark.parametrize("delay", [-0.3, 0.0, 0.4])
@pytest.mark.parametrize("plant", ["exact", "late"])
def test_experiments_simulated_together_are_each_as_alone(plant: str, delay: float) -> None:
    late = BENCH.plant(plant)
    rng = np.random.default_rng(1)
    windows = [
        replace(planned(rng.normal(size=n)), before=0.5 * n, late=None if n == 7 else 1e-4 * rng.random(n))
        for n in (5, 7, 5)
    ]
    starts = np.array([[0.1, 3.0], [-0.2, -8.0], [0.0, 0.0]])
    names = ("k_m", "f_v", "x1_0", "x2_0")
    theta = Theta(BRAKE, errors=SystematicErrors(0.01, 0.2, delay, 0.03), contact=0.05)
    together = simulate_apart(late, theta, windows, starts, T_S, names, march)
    alone = [
        simulate(late, theta._replace(start=(x1, x2)), window, T_S, names)
        for window, (x1, x2) in zip(windows, starts.tolist(), strict=True)
    ]
    np.testing.assert_array_equal(together.samples, np.concatenate([one.samples for one in alone]))
    np.testing.assert_array_equal(together.sensitivities, np.concatenate([one.sensitivities for one in alone]))
