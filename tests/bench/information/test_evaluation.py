from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from emb_bench.config.bench import Bench
from emb_bench.experiment.experiment import Experiment, Floats, planned
from emb_bench.experiment.simulate import NO_ERRORS, SystematicErrors, Theta, simulate
from emb_bench.information.evaluation import Fit, Question, expected, information_and_fit

FINE = 20  # Steps of the simulation in a period
CURRENTS = np.repeat([2.0, -1.5, 1.0, 0.3], 20)


def shown(
    bench: Bench, late: int = 0, offset: float = 0.0, current_offset: float = 0.0, gain: float = 0.0
) -> Experiment:
    """What the sensors of a brake show without noise, simulated in short steps.

    Args:
        bench: the brake.
        late: by which each command acts late, or its sample is taken late if negative [steps].
        offset: of the encoder [rad].
        current_offset: acts besides [A].
        gain: relative error of the velocity's scale.
    """
    acted = np.concatenate([np.zeros(max(late, 0)), np.repeat(CURRENTS, FINE)]) + current_offset
    plant, t_s = bench.plant("exact"), bench.timing.sample_time
    fine = simulate(plant, Theta(bench.brake), planned(acted), t_s / FINE).states
    at = np.arange(FINE, len(CURRENTS) * FINE, FINE)
    x = fine[at - min(late, 0)]
    return Experiment("", CURRENTS[: len(x)], x * [1.0, 1.0 + gain] + [offset, 0.0], 0.0, 0.0, 0.0, True)


def evaluated(bench: Bench, run: Experiment, errors: SystematicErrors, *names: str) -> tuple[Floats, Fit]:
    """The physical information of an experiment that is evaluated in parts, and the fit."""
    theta, last = Theta(bench.brake, errors=errors), [run.periods - 1]
    histories, fit = information_and_fit(bench, bench.plant("exact"), theta, run, names, instants=last, piece=30)
    return histories["physical"][-1], fit


@pytest.mark.parametrize(
    ("simulated", "errors", "most"),
    [
        ({"late": 6}, SystematicErrors(delay=0.3), 1e-6),
        ({"offset": 0.04}, SystematicErrors(offset=0.04), 1e-6),
        ({"current_offset": 0.05}, SystematicErrors(current_offset=0.05), 1e-6),
        ({"gain": 0.02}, SystematicErrors(velocity_gain=0.02), 1e-6),
        (
            {"late": 6, "offset": -0.04, "current_offset": 0.05, "gain": -0.02},
            SystematicErrors(-0.04, 0.05, 0.3, -0.02),
            1e-6,
        ),
        ({"late": -1}, SystematicErrors(delay=-0.05), 0.2),  # to first order
    ],
)
def test_a_record_is_explained_with_its_systematic_errors_only(
    bench: Bench, simulated: dict[str, Any], errors: SystematicErrors, most: float
) -> None:
    piece = shown(bench, **simulated)
    (_, explained), (_, alone) = (evaluated(bench, piece, each, "k_m") for each in (errors, NO_ERRORS))
    assert max(explained.compared) < most
    assert max(alone.compared) > 1.0


def test_the_information_about_systematic_errors_is_that_of_finite_differences(bench: Bench) -> None:
    at: dict[str, Any] = {"late": 6, "offset": 0.01, "current_offset": 0.05, "gain": 0.02}
    steps = {"delay": ("late", 1, 1 / FINE), "current_offset": ("current_offset", 1e-4, 1e-4)}
    steps |= {"offset": ("offset", 1e-4, 1e-4), "velocity_gain": ("gain", 1e-4, 1e-4)}
    rows = []
    for option, step, size in steps.values():
        more, less = (shown(bench, **at | {option: at[option] + sign * step}) for sign in (1, -1))
        derivative = (more.samples - less.samples) / (2.0 * size)
        rows.append((derivative / [bench.noise.angle, bench.noise.velocity]).ravel())
    found, _ = evaluated(bench, shown(bench, **at), SystematicErrors(0.01, 0.05, 0.3, 0.02), *steps)
    expected = np.array(rows) @ np.array(rows).T
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-3)


@pytest.mark.parametrize("errors", [NO_ERRORS, SystematicErrors(offset=-0.7)])
def test_a_planned_experiment_begins_at_the_origin_whatever_the_encoder_reads_there(
    bench: Bench, errors: SystematicErrors
) -> None:
    exact = bench.plant("exact")
    shifted = replace(exact, instruments=exact.instruments._replace(encoder_offset=0.4))
    found, right = (expected(bench, one, Question(), bench.brake, errors, CURRENTS) for one in (shifted, exact))
    assert found.trajectory.states.tolist() == right.trajectory.states.tolist()
    assert found.matrix.tolist() == right.matrix.tolist()
