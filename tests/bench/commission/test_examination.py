"""Examination of logs: a model that grows where experiments ask for more, and where the velocity comes from."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.random import Generator

from emb_bench.commission.examination import identify, velocity_of
from emb_bench.commission.records import Identification, Velocity
from emb_bench.config.bench import Bench
from emb_bench.experiment.experiment import Experiment, Floats, planned
from emb_bench.logs.log import read_log
from emb_runtime.config.bench import PARAMETER_NAMES, Sensors
from tests.bench.simulated_logs import square, write_log
from tests.conftest import Simulate


def logs_of(folder: Path, simulate: Simulate, plant: str, seeds: tuple[int, ...] = (1, 2)) -> list[Path]:
    """Experiments of one simulated brake, each with its own noise."""
    return [
        write_log(folder / f"{plant}-{seed}.mcap", simulate(square, options=f"plant={plant},seed={seed}"))
        for seed in seeds
    ]


def identified(bench: Bench, logs: list[Path], before: Identification | None = None) -> Identification:
    wide = replace(bench, shield=bench.shield._replace(ranges="pm50"))
    return identify([read_log(log) for log in logs], wide, bench.noise, before)


def holds_the_truth(bench: Bench, one: Identification) -> bool:
    truth = bench.brake._asdict()
    return all(one.intervals[name][0] <= truth[name] <= one.intervals[name][1] for name in PARAMETER_NAMES)


def test_two_experiments_tell_which_feature_the_brake_has(bench: Bench, tmp_path: Path, simulate: Simulate) -> None:
    logs = logs_of(tmp_path, simulate, "play")
    found = identified(bench, logs)
    # The next experiments are fitted with the features found, and look for no others where that explains them.
    for one in (found, identified(bench, logs[1:], found)):
        assert one.fits
        assert (one.model, set(one.features)) == ("exact + play", {"play"})
    assert found.features["play"] == pytest.approx(bench.plant("play").mechanics.play, rel=0.2)
    assert holds_the_truth(bench, found)


def test_a_single_experiment_grows_no_model(bench: Bench, tmp_path: Path, simulate: Simulate) -> None:
    found = identified(bench, logs_of(tmp_path, simulate, "hysteresis", (1,)))
    assert not found.fits
    assert not found.features
    assert found.objections


def test_a_plain_brake_stays_plain(bench: Bench, tmp_path: Path, simulate: Simulate) -> None:
    plain = identified(bench, logs_of(tmp_path, simulate, "exact"))
    assert plain.fits
    assert (plain.model, plain.features) == ("exact", {})
    low, high = plain.intervals["k_m"]
    assert high - low < bench.systematic.inertia * plain.values["k_m"]  # the shield shares the error of J
    assert holds_the_truth(bench, plain)


@pytest.mark.slow
def test_features_that_do_not_explain_larger_experiments_are_added_to(
    bench: Bench, tmp_path: Path, simulate: Simulate
) -> None:
    plain = identified(bench, logs_of(tmp_path, simulate, "exact", (1,)))
    before = replace(plain, model="exact + hysteresis", features={"hysteresis": 0.01})
    found = identified(bench, logs_of(tmp_path, simulate, "cubic"), before)
    assert found.fits
    assert {"quadratic", "cubic"} <= set(found.features)
    assert holds_the_truth(bench, found)


T_S = 1e-3
PARTS = 20  # Steps in a sample
STRONG, WEAK = 2e4, 2e3  # Accelerations [rad/s²]


def motion(generator: Generator, acceleration: float, periods: int = 500) -> tuple[Floats, Floats]:
    """True angles and velocities, ``PARTS`` in a sample, of a brake that is driven to and fro from rest."""
    signs = np.repeat(np.resize([1.0, -1.0, -1.0, 1.0], periods // 10), 10 * PARTS)
    pushed = acceleration * signs * np.repeat(generator.uniform(0.3, 1.0, periods // 10), 10 * PARTS)
    pushed[: 30 * PARTS] = 0.0
    step = T_S / PARTS
    velocity = np.concatenate([[0.0], np.cumsum(pushed) * step])
    angle = np.concatenate([[0.0], np.cumsum(0.5 * step * (velocity[1:] + velocity[:-1]))])
    return angle, velocity


def looped(angles: Floats, bandwidth: float, damping: float, step: float) -> Floats:
    """Velocities of a tracking loop that sees an angle each ``step`` [s], placed by its poles."""
    pole = np.exp(complex(-damping, np.sqrt(1.0 - damping**2)) * bandwidth * step)
    position, speed, shown = angles[0], 0.0, []
    for angle in angles:
        ahead = position + step * speed
        position = ahead + (1.0 - abs(pole) ** 2) * (angle - ahead)
        speed += (1.0 + abs(pole) ** 2 - 2.0 * pole.real) / step * (angle - ahead)
        shown.append(speed)
    return np.array(shown)


def recorded(
    seed: int, acceleration: float, bandwidth: float = 0.0, damping: float = 0.7, parts: int = 1, noise: float = 1e-3
) -> Experiment:
    """What is on the bus: the velocity of a sensor, or of a loop that sees ``parts`` noisy angles in a sample."""
    generator = np.random.default_rng(seed)
    angle, velocity = motion(generator, acceleration)
    seen = angle[:: PARTS // parts] + generator.normal(0.0, noise, angle[:: PARTS // parts].shape)
    shown = velocity[::PARTS] + generator.normal(0.0, 0.7, velocity[::PARTS].shape)
    if bandwidth:
        shown = looped(seen, bandwidth, damping, T_S / parts)[::parts]
    samples = np.round(np.stack([seen[::parts] / 2e-5, shown / 1e-4], axis=1)) * [2e-5, 1e-4]  # as our node sends them
    return replace(planned(np.zeros(len(shown) - 1)), samples=samples[1:], first=tuple(samples[0]))


@pytest.mark.parametrize("acceleration", [WEAK, STRONG])
@pytest.mark.parametrize("bandwidth", [600.0, 800.0, 1520.0, 2500.0, 4000.0])
def test_of_a_loop_on_the_angles_of_the_bus_nearly_its_bandwidth_is_declared(
    bandwidth: float, acceleration: float
) -> None:
    for damping in (0.7, 0.76, 1.0):
        found = velocity_of([recorded(s, acceleration, bandwidth, damping) for s in (1, 2)], T_S)
        assert 0.93 * min(bandwidth, 3.0 / T_S) <= found.least <= min(bandwidth, 3.0 / T_S), damping
        assert found.most >= 0.97 * bandwidth
        assert found.sensors == Sensors("observer", found.least)


@pytest.mark.parametrize("parts", [5, 20])
@pytest.mark.parametrize("noise", [1e-3, 1e-4])
@pytest.mark.parametrize("bandwidth", [800.0, 1520.0, 4000.0])
def test_of_a_loop_in_a_drive_that_sees_more_angles_no_larger_bandwidth_is_declared(
    bandwidth: float, noise: float, parts: int
) -> None:
    for acceleration, damping in itertools.product((WEAK, STRONG), (0.7, 0.9)):
        found = velocity_of([recorded(3, acceleration, bandwidth, damping, parts, noise)], T_S)
        assert 0.0 < found.least <= 1.01 * bandwidth, (acceleration, damping)


@pytest.mark.parametrize("acceleration", [0.0, WEAK, STRONG])
def test_a_sensor_is_no_observer(acceleration: float) -> None:
    for seed, noise in itertools.product(range(4), (1e-3, 1e-4)):
        found = velocity_of([recorded(seed, acceleration, noise=noise)], T_S)
        assert (found, found.sensors, str(found)) == (Velocity(), Sensors(), "a sensor's")
