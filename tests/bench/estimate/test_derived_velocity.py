"""A velocity that an observer derives from the angle is told from a measured one, whatever moves the brake."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.independent_simulator import brake_of, simulate
from emb_bench.config.bench import Bench, load_bench
from emb_bench.estimate.derived_velocity import derived
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.records import Derived, EstimationProblem
from emb_bench.estimate.suspects import cause
from emb_bench.experiment.experiment import Experiment
from emb_bench.report.sentences import alarms, derived_velocity
from emb_runtime.config.bench import PARAMETER_NAMES, Sensors

from tests.bench.measurements import currents_of, fit, record  # isort: skip

T_S = 1e-3
MEASURED = tuple(name for name, plant in load_bench().plants.items() if not plant.instruments.observer_bandwidth)


def drawn(bench: Bench, seed: int, plant: str = "exact", **changed: Any) -> Experiment:
    rng = np.random.default_rng(seed)
    brake = brake_of(bench, bench.plant(plant), rng.uniform(0.5, 1.5, 4))
    return simulate(replace(brake, **changed), bench, rng, f"seed {seed}")


def observed(bench: Bench, bandwidth: float, seed: int, damping: float, parts: int) -> Experiment:
    """A record whose velocity is that of a loop of second order, integrated in so many steps of each period.

    ``parts`` of 1000 is a continuous loop. Between samples it sees the motion along a parabola.
    """
    data, rng = drawn(bench, seed), np.random.default_rng(seed)
    angle, velocity = data.samples.T
    tracked, shown, speed, at = 0.0, 0.0, 0.0, 0.0
    velocities = []
    for true_angle, true_velocity in zip(angle.tolist(), velocity.tolist(), strict=True):
        step = T_S / parts
        for k in range(1, parts + 1):
            share = k / parts
            along = at + T_S * (share * speed + 0.5 * share**2 * (true_velocity - speed))
            along += share * (true_angle - at - 0.5 * T_S * (speed + true_velocity))
            error = along - tracked
            shown += step * bandwidth**2 * error
            tracked += step * (shown + 2.0 * damping * bandwidth * error)
        at, speed = true_angle, true_velocity
        velocities.append(round(shown, 2))
    noise = bench.noise.angle * rng.standard_normal(len(angle))
    return replace(data, samples=np.stack([angle + noise, np.array(velocities)], axis=1))


@pytest.mark.parametrize("bandwidth", [400.0, 800.0, 1100.0, 1520.0, 2100.0, 3040.0, 4000.0])
def test_the_bandwidth_of_an_observer_that_is_sampled_with_the_angle_is_found(bench: Bench, bandwidth: float) -> None:
    for seed in range(3):
        found = derived([drawn(bench, seed, observer_bandwidth=bandwidth)], T_S)
        assert found is not None
        assert found.is_known
        assert found.bandwidth == pytest.approx(bandwidth, rel=0.03)
        assert found.p_value < 1e-20


@pytest.mark.parametrize("bandwidth", [400.0, 800.0, 1520.0, 3040.0])
@pytest.mark.parametrize("damping", [0.7, 1.0])
def test_the_bandwidth_of_a_continuous_observer_is_found_or_a_least_one(
    bench: Bench, bandwidth: float, damping: float
) -> None:
    for seed in range(2):
        found = derived([observed(bench, bandwidth, seed, damping, 1000)], T_S)
        assert found is not None
        if found.is_known:
            assert found.bandwidth == pytest.approx(bandwidth, rel=0.15)
        else:
            assert bandwidth > 1000.0
            assert 0.4 * bandwidth < found.least < 1.05 * bandwidth


@pytest.mark.parametrize("plant", MEASURED)
def test_a_measured_velocity_is_no_observer_s_on_any_plant(bench: Bench, plant: str) -> None:
    assert not any(derived([drawn(bench, seed, plant)], T_S) for seed in range(5))


@pytest.mark.parametrize(
    "sensors",
    [
        {"delay": 0.5},
        {"delay": 0.85},
        {"velocity_gain": 0.05},
        {"clock_jitter": 1e-4},
        {"encoder_step": 2e-2},
        {"velocity_walk": 30.0},
        {"angle_scale": 0.02},
    ],
)
def test_no_other_fault_of_the_sensors_is_taken_for_an_observer(bench: Bench, sensors: dict[str, Any]) -> None:
    assert not any(derived([drawn(bench, seed, **sensors)], T_S) for seed in range(5))


def test_a_record_of_a_few_samples_tells_nothing_of_its_sensors(bench: Bench) -> None:
    records = [drawn(bench, seed, observer_bandwidth=bandwidth) for seed in range(20) for bandwidth in (0.0, 1000.0)]
    assert not [n for n in range(1, 9) for data in records if derived([data.part(100, 100 + n)], T_S)]
    assert all(derived([data.part(100, 200)], T_S) for data in records[1::2])


def test_an_observer_is_found_beside_lost_samples_and_in_any_of_several_records(bench: Bench) -> None:
    data = drawn(bench, 1, observer_bandwidth=900.0)
    lost = data.lose(np.random.default_rng(0).random(data.periods) < 0.02)
    still = replace(data, samples=np.zeros_like(data.samples))
    nothing = replace(data, samples=np.full_like(data.samples, np.nan))
    found = derived([still, nothing, lost], T_S)
    assert found is not None
    assert found.bandwidth == pytest.approx(900.0, rel=0.05)
    assert derived([still, nothing], T_S) is None


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (Derived(1523.0, 1480.0, True, 0.0), 'about 1500 rad/s: declare it ([sensors] velocity = "observer", '),
        (Derived(1523.0, 1480.0, True, 0.0), "observer_bandwidth = 1300) in a bench file: --bench FILE"),
        (Derived(5900.0, 2960.0, False, 0.0), "bandwidth at least 3000 rad/s: "),
    ],
)
def test_an_observer_is_said_in_words_that_can_be_typed(found: Derived, said: str) -> None:
    assert said in derived_velocity(found, None)
    assert derived_velocity(found, None).startswith("the velocity is derived from the angle, bandwidth ")


@pytest.mark.parametrize(
    ("bandwidth", "said", "params", "method"),
    [
        (800.0, "about 800 rad/s", PARAMETER_NAMES, "oem"),
        (1520.0, "about 1500 rad/s", PARAMETER_NAMES, "oem"),
        (1520.0, "about 1500 rad/s", ("k_m",), "oem"),
        (1520.0, "about 1500 rad/s", PARAMETER_NAMES, "pem"),
        (4000.0, "about 4000 rad/s", PARAMETER_NAMES, "oem"),
    ],
)
def test_an_observer_that_is_not_declared_is_the_first_suspect_and_what_is_said_mends_it(
    bench: Bench, bandwidth: float, said: str, params: tuple[str, ...], method: str
) -> None:
    plant, asked = bench.plant("observer"), EstimationProblem(params)
    plant = replace(plant, instruments=plant.instruments._replace(observer_bandwidth=bandwidth))
    data = record(bench, plant, currents_of(bench, "chirp"))
    found = fit(bench, "exact", [data], asked, method=method)
    assert not found.validation.fits
    assert found.validation.cause is not None
    assert found.validation.cause.suspect.name == "velocity_lag"
    assert said in alarms(found)[0]
    declared = replace(bench, sensors=Sensors("observer", 0.5 * bandwidth))
    assert fit(declared, declared.model("exact"), [data], asked, method=method).validation.fits


def test_a_lag_that_no_observer_makes_explains_no_misfit(bench: Bench) -> None:
    """A score test alone finds a lag in other misfits too."""
    found = fit(bench, "exact", [record(bench, bench.plant("late"), currents_of(bench, "chirp"))]).validation
    assert "score of velocity_lag" in found.alarming
    assert found.cause is not None
    assert found.cause.suspect.name == "delay"
    lag = tuple(suspect for suspect in found.suspects if suspect.name == "velocity_lag")
    assert cause(replace(found, suspects=lag), None) is None


@pytest.mark.parametrize("plant", ["exact", "stribeck", "late", "observer"])
def test_a_declared_observer_stands_behind_every_plant_and_its_bandwidth_does_not_matter(
    bench: Bench, plant: str
) -> None:
    moved = bench.plant(plant)
    moved = replace(moved, instruments=moved.instruments._replace(observer_bandwidth=1600.0))
    data = record(bench, moved, currents_of(bench, "chirp"))

    def estimated(bandwidth: float) -> Estimate:
        declared = replace(bench, sensors=Sensors("observer", bandwidth))
        return fit(declared, declared.model(plant), [data])

    whole, half = estimated(1600.0), estimated(800.0)
    assert whole.validation.fits
    assert whole.values.tolist() == half.values.tolist()
    assert list(whole.validation.whiteness) == ["angle"]
    assert bench.model(plant) is bench.plant(plant)
