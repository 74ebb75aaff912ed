from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest

from emb_bench.brake.motion import Floats, advance, no_sensitivity, rest
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_bench.estimate.effects import Linearised, Simulation, with_systematic
from emb_bench.estimate.records import SYSTEMATIC, EstimationProblem
from emb_bench.experiment.experiment import Experiment
from emb_bench.report.sentences import explained
from emb_runtime.config.bench import PARAMETER_NAMES, Systematic

from tests.bench.measurements import currents_of, errors_in_sigmas, fit, problem_of, record  # isort: skip

SIZES = {"k_m": 0.03, "k_1": 0.01, "T_c": 0.1, "f_v": 0.1}
EXCITATIONS = ("chirp", "multisine", "constant-speed:turn=0.15")


def motion(bench: Bench, currents: Floats, name: str, drift: float) -> Floats:
    """Angle and velocity at the samples of a brake that changes from period to period, none in the middle."""
    mechanics, t_s, n = bench.plant("exact").mechanics, bench.timing.sample_time, len(currents)
    (chosen, s), x, states = no_sensitivity(()), rest(), np.empty((n, 2))
    for k, u in enumerate(currents.tolist()):
        factor = 1.0 + drift * ((k + 0.5) / n - 0.5)
        brake = bench.brake._replace(**{name: getattr(bench.brake, name) * factor})
        compiled(advance)(mechanics, brake, x, u, t_s, chosen, s)
        states[k] = x[:2]
    return states


def drifting(bench: Bench, text: str, name: str, drift: float, seed: int) -> Experiment:
    currents = currents_of(bench, text)
    still = record(bench, bench.plant("exact"), currents, seed=seed)
    moved = motion(bench, currents, name, drift) - motion(bench, currents, name, 0.0)
    return replace(still, samples=still.samples + moved)


@pytest.mark.parametrize("name", PARAMETER_NAMES)
@pytest.mark.parametrize("text", EXCITATIONS)
def test_its_column_is_the_finite_difference_of_a_brake_that_drifts(bench: Bench, name: str, text: str) -> None:
    currents = currents_of(bench, text)
    problem = problem_of(bench, PARAMETER_NAMES, record(bench, bench.plant("exact"), currents))
    z = problem.nominal()
    weights = problem.weights(z)
    model = Linearised(problem, z, Simulation(problem, z, weights), 0, np.zeros((0, len(z))), (f"{name}_drift",))
    column = model.turned(f"{name}_drift")
    assert column is not None
    h = 1e-5
    expected = (motion(bench, currents, name, h) - motion(bench, currents, name, -h)) / (2.0 * h) * weights[0]
    assert np.linalg.norm(column - expected) < 1e-4 * np.linalg.norm(expected)


@pytest.mark.parametrize(
    ("name", "method"),
    [(name, method) for name in PARAMETER_NAMES for method in ("oem", "pem") if (name, method) != ("k_1", "pem")],
)
def test_a_parameter_that_drifts_is_found_with_its_size_and_named_with_a_remedy(
    bench: Bench, name: str, method: str
) -> None:
    data = drifting(bench, "square:period=0.2", name, SIZES[name], seed=3)
    m = fit(bench, "exact", [data], method=method).validation
    assert not m.fits
    assert m.cause is not None
    assert m.cause.suspect.name == f"{name}_drift"
    assert m.cause.suspect.value == pytest.approx(SIZES[name], rel=0.3)
    said = explained(m.cause)
    assert f"a change of {name} over the run " in said
    assert "shorter" in said


def test_a_drift_of_the_stiffness_is_to_prediction_error_a_load_that_walks_whose_first_suspect_it_is(
    bench: Bench,
) -> None:
    data = drifting(bench, "square:period=0.2", "k_1", SIZES["k_1"], seed=3)
    e = fit(bench, "exact", [data], method="pem")
    assert e.validation.disturbance is not None
    assert e.validation.disturbance.load > 0.0
    assert e.validation.suspects[0].name == "k_1_drift"
    assert e.validation.suspects[0].value == pytest.approx(SIZES["k_1"], rel=0.3)
    low, high = e.intervals()[[u.name for u in e.unknowns].index("k_1")]
    assert low < bench.brake.k_1 < high


@pytest.mark.parametrize(("name", "drift"), [("k_1", 0.03), ("T_c", 0.03)])
def test_the_interval_holds_what_a_drift_that_a_walk_followed_began_and_ended_with(
    bench: Bench, name: str, drift: float
) -> None:
    asked = with_systematic(EstimationProblem(), bench, bench.plant("exact"))
    e = fit(bench, "exact", [drifting(bench, "square:period=0.2", name, drift, seed=3)], asked, method="pem")
    assert e.process_noise + e.load_noise > 0.0
    low, high = e.intervals()[[u.name for u in e.unknowns].index(name)] / getattr(bench.brake, name)
    assert low < 1.0 - 0.5 * drift
    assert 1.0 + 0.5 * drift < high


@pytest.mark.parametrize("seed", [3, 4])
def test_the_interval_allows_for_a_drift_that_is_too_small_to_be_noticed(bench: Bench, seed: int) -> None:
    data = drifting(bench, "square:period=0.2", "T_c", 3e-4, seed=seed)
    errors_of_sensors = {name: getattr(bench.systematic, name) for name in SYSTEMATIC}
    others = dict.fromkeys(asdict(bench.systematic), 0.0) | {"k_m": None} | errors_of_sensors
    asked = [
        with_systematic(EstimationProblem(), replace(bench, systematic=Systematic(**known)), bench.plant("exact"))
        for known in (others, others | {"drift": bench.systematic.drift})
    ]
    found = [fit(bench, "exact", [data], one) for one in asked]
    errors = [errors_in_sigmas(e, bench.brake)[0] for e in found]
    assert [e.validation.fits for e in found] == [True, True]
    assert abs(errors[0]) > 2.5
    assert abs(errors[1]) < 2.0
    assert found[0].values == pytest.approx(found[1].values)
