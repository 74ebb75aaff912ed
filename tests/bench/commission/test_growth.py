"""The model: it grows where experiments ask for more, and goes on from what it found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from emb_bench.commission.examination import identify
from emb_bench.commission.records import Identification
from emb_bench.config.bench import Bench
from emb_bench.logs.log import read_log
from emb_runtime.config.bench import PARAMETER_NAMES

from tests.bench.simulated_logs import square, write_log  # isort: skip
from tests.conftest import Simulate  # isort: skip


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
