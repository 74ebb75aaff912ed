from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from emb_bench.analysis.held_out import held_out, leave_one_out
from emb_bench.config.bench import Bench
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.records import EstimationProblem
from emb_bench.experiment.experiment import Experiment, planned
from emb_bench.experiment.simulate import Theta, simulate

from tests.bench.flows import square  # isort: skip
from tests.bench.measurements import disturbed, fit, record  # isort: skip

CURRENTS, OTHERS = square(15, 3.0)[:60], square(10, -2.0)[:40]
PARAMS = ("k_m", "f_v")


def estimated(
    bench: Bench, records: Sequence[Experiment], *nuisances: str, params: tuple[str, ...] = PARAMS
) -> Estimate:
    return fit(bench, "exact", records, EstimationProblem(params, nuisances))


def run(bench: Bench, seed: int, plant: str = "exact", currents: object = CURRENTS, **changes: float) -> Experiment:
    brake = bench.brake._replace(**changes)
    return record(bench, bench.plant(plant), np.asarray(currents, dtype=np.float64), brake=brake, seed=seed)


def test_the_statistic_is_the_error_of_the_prediction_over_its_covariance(bench: Bench) -> None:
    """e^T (I + J C J^T)⁻¹ e, with the matrix written out."""
    e, new = estimated(bench, [run(bench, 0, currents=CURRENTS[:20])]), run(bench, 1, currents=OTHERS)
    found = held_out(e, new)
    t_s, sigma = bench.timing.sample_time, np.array([bench.noise.angle, bench.noise.velocity])
    said = simulate(e.plant, Theta(e.theta), planned(OTHERS), t_s, PARAMS)
    errors = ((new.samples - said.states[1:]) / sigma).ravel()
    jacobian = (said.sensitivities / sigma).transpose(0, 2, 1).reshape(-1, 2)
    covariance = np.eye(80) + jacobian @ np.linalg.inv(e.information) @ jacobian.T
    assert found.chi2 == pytest.approx(float(errors @ np.linalg.solve(covariance, errors)), rel=1e-3)
    assert found.freedom == 80
    assert found.p_value == pytest.approx(stats.chi2.sf(found.chi2, 80), rel=1e-6)
    assert float(errors @ errors) > 1.05 * found.chi2


@pytest.mark.parametrize("nuisances", [(), ("offset",)])
def test_under_the_right_model_p_values_are_uniform(bench: Bench, nuisances: tuple[str, ...]) -> None:
    p_values = []
    for seed in range(80):
        e = estimated(bench, [run(bench, 2 * seed)], *nuisances)
        p_values.append(held_out(e, run(bench, 2 * seed + 1, currents=OTHERS)).p_value)
    assert stats.kstest(p_values, "uniform").pvalue > 0.01


@pytest.mark.parametrize(("plant", "changes"), [("stribeck", {}), ("lag", {}), ("exact", {"f_v": 4e-5})])
def test_another_brake_is_not_predicted(bench: Bench, plant: str, changes: dict[str, float]) -> None:
    e = estimated(bench, [run(bench, 0)])
    found = held_out(e, replace(run(bench, 1, plant, **changes), name="other.mcap"))
    assert (found.name, found.fits) == ("other.mcap", False)
    assert found.p_value < 1e-6
    assert held_out(e, run(bench, 1)).fits


def test_what_the_new_record_alone_has_costs_a_degree_of_freedom_each(bench: Bench) -> None:
    """Where the encoder was homed was seen once more before the record, which is one sample more."""
    new = run(bench, 1)
    plain = held_out(estimated(bench, [run(bench, 0)]), new)
    homed = held_out(estimated(bench, [run(bench, 0)], "offset"), new)
    pushed = held_out(estimated(bench, [run(bench, 0)], "x2_0"), new)
    assert (plain.freedom, homed.freedom, pushed.freedom) == (120, 120, 119)
    shifted = replace(new, samples=new.samples + np.array([0.3, 0.0]), angle=new.angle + 0.3, from_origin=False)
    assert held_out(estimated(bench, [run(bench, 0)], "offset"), shifted).fits
    assert not held_out(estimated(bench, [run(bench, 0)]), shifted).fits


def test_what_the_estimate_does_not_tell_is_free_in_the_prediction(bench: Bench) -> None:
    """The first brake never clamps; the second one does, and its stiffness costs one degree of freedom."""
    e = estimated(bench, [run(bench, 0, currents=np.full(60, -0.8))], params=("k_m", "k_1"))
    found = held_out(e, run(bench, 1, k_1=1.3 * bench.brake.k_1))
    assert found.fits
    assert found.freedom == 119


def test_each_record_is_predicted_from_the_others(bench: Bench) -> None:
    records = [replace(run(bench, n), name=f"{n}.mcap") for n in range(4)]
    joint = estimated(bench, records)
    found = leave_one_out(joint)
    assert [one.name for one in found] == ["0.mcap", "1.mcap", "2.mcap", "3.mcap"]
    assert all(one.fits for one in found)
    others = estimated(bench, [*records[:2], records[3]])
    assert found[2].chi2 == pytest.approx(held_out(others, records[2]).chi2, rel=1e-6)


def test_prediction_errors_of_a_disturbed_brake_are_those_of_its_filter(bench: Bench) -> None:
    """A brake that is pushed at random is no longer where a simulation has it."""
    *records, new = (disturbed(bench, CURRENTS, bench.brake, seed, walk=50.0) for seed in range(4))
    e = fit(bench, "exact", records, EstimationProblem(PARAMS), method="pem")
    assert e.process_noise > 0.0
    assert held_out(e, new).fits
    assert not held_out(replace(e, method="oem"), new).fits
