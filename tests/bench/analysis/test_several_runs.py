"""Records predicted from others; what runs of one brake share does not tell them apart, a false alarm hides nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from emb_bench.analysis import held_out as module
from emb_bench.analysis.drift import Earlier, Entry, drifts
from emb_bench.analysis.held_out import GROUPS, apart, held_out, leave_one_out
from emb_bench.analysis.several_runs import apart_by
from emb_bench.config.bench import Bench
from emb_bench.estimate.effects import with_systematic
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.records import NORMAL_95, EstimationProblem
from emb_bench.experiment.experiment import Experiment, planned
from emb_bench.experiment.simulate import Theta, simulate
from emb_runtime.config.bench import PARAMETER_NAMES
from tests.bench.flows import square
from tests.bench.measurements import currents_of, disturbed, fit, record

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


def test_effects_that_move_both_runs_alike_tell_them_apart_by_no_more_than_the_rest() -> None:
    for deviation, effects, other, expected in (
        (5.0, {}, {}, 5.0),
        (5.0, {"play": (3.0, 0.1)}, {"play": (3.0, 0.1)}, 4.0),
        (5.0, {"play": (3.0, 0.1)}, {"play": (6.0, 0.2)}, 4.0),  # less is known of its size, which is the same
        (5.0, {"play": (3.0, 0.1)}, {"play": (-3.0, 0.1)}, (16.0 + 36.0) ** 0.5),
        (5.0, {"play": (3.0, 0.1)}, {"play": (0.0, 0.0)}, 5.0),
        (5.0, {"play": (3.0, 0.1)}, {}, 5.0),
        (5.0, {"T_c_drift": (3.0, 0.1)}, {"T_c_drift": (3.0, 0.1)}, 5.0),  # another one in each run
        (5.0, {"play": (3.0, 0.1), "f_v_drift": (-4.0, 0.1)}, {"play": (3.0, 0.1), "f_v_drift": (-4.0, 0.1)}, 4.0),
        (np.inf, {"play": (3.0, 0.1)}, {"play": (3.0, 0.1)}, np.inf),
    ):
        assert apart_by(deviation, effects, other) == pytest.approx(expected), (effects, other)


def earlier(e: Estimate) -> Earlier:
    """An estimate as its JSON has it."""
    rows = zip(e.labels, e.values.tolist(), e.between_runs().tolist(), strict=True)
    found = {name: Entry(value, True, deviation, e.effects(i)) for i, (name, value, deviation) in enumerate(rows)}
    return Earlier({name: found[name] for name in PARAMETER_NAMES})


def test_a_drift_shows_below_what_an_effect_of_the_brake_leaves_open_in_each_run(bench: Bench) -> None:
    """Play leaves T_c open to 0.3 %, in two runs alike; without the effects a change by 0.2 % would be none."""
    plant, currents = bench.plant("exact"), currents_of(bench, "chirp")
    asked = with_systematic(EstimationProblem(), bench, plant)
    loose = replace(plant, mechanics=plant.mechanics._replace(play=0.05))
    first, same, rubbed = (
        fit(bench, plant, [record(bench, loose, currents, seed=seed, brake=brake)], asked)
        for seed, brake in enumerate((bench.brake, bench.brake, bench.brake._replace(T_c=1.002 * bench.brake.T_c)))
    )
    assert all(e.validation.fits for e in (first, same, rubbed))
    assert not any(drift.drifted for drift in drifts(same, earlier(first)))
    found = {drift.name: drift for drift in drifts(rubbed, earlier(first))}
    assert [name for name, drift in found.items() if drift.drifted] == ["T_c"]
    both = math.hypot(first.between_runs()[2], rubbed.between_runs()[2])
    assert found["T_c"].detectable < 0.002 < NORMAL_95 * both


def test_many_records_are_predicted_from_few_estimates(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    currents, refitted, refit = currents_of(bench, "chirp"), list[Sequence[int]](), module.refit

    def counted(e: Estimate, chosen: Sequence[int]) -> Estimate:
        refitted.append(chosen)
        return refit(e, chosen)

    monkeypatch.setattr(module, "refit", counted)
    e = fit(bench, "exact", [record(bench, bench.plant("exact"), currents, seed=seed) for seed in range(GROUPS + 2)])
    assert all(one.fits for one in leave_one_out(e))
    assert refitted == [[1, 2, 3, 5], [0, 2, 3, 4], [0, 1, 3, 4, 5], [0, 1, 2, 4, 5]]


def test_changed_brakes_are_named_though_one_log_raises_a_false_alarm(bench: Bench) -> None:
    """Four logs, the last two with another f_v; the first is too noisy to fit alone."""
    plant, currents = bench.plant("exact"), currents_of(bench, "chirp")
    asked = with_systematic(EstimationProblem(), bench, plant)
    changed = bench.brake._replace(f_v=1.01 * bench.brake.f_v)
    noisy = record(bench, plant, currents, seed=9, noise=1.5)
    others = [record(bench, plant, currents, seed=i, brake=changed if i > 1 else bench.brake) for i in range(4)]
    found = apart(fit(bench, plant, [noisy, *others], asked))
    assert [one.name for one in found] == ["f_v"]
    assert found[0].values == pytest.approx(
        [math.nan, *[bench.brake.f_v] * 2, *[changed.f_v] * 2], rel=2e-3, nan_ok=True
    )
    assert apart(fit(bench, plant, [noisy, others[0]], asked)) == ()
