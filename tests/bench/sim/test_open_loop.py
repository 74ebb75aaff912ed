from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from emb_bench.brake.euler import step
from emb_bench.config.bench import load_bench
from emb_bench.experiment.experiment import planned
from emb_bench.experiment.simulate import SystematicErrors, Theta, simulate, simulate_apart
from emb_bench.sim.open_loop import march
from emb_runtime.errors import UsageError
from tests.bench.flows import ALL, euler_states, of_euler, square

BENCH = load_bench()
BRAKE = BENCH.brake
T_S = BENCH.timing.sample_time
EULER = BENCH.plant("euler")
EXACT = BENCH.plant("exact")


def test_a_trajectory_is_one_step_after_the_other_and_begins_at_its_start() -> None:
    currents = [3.0, -1.0, 2.0]
    states = euler_states(BRAKE, currents, (1.0, -20.0))
    assert states.shape == (4, 2)
    assert tuple(states[0]) == (1.0, -20.0)
    for (x1, x2), u, after in zip(states.tolist(), currents, states[1:], strict=False):
        assert tuple(after) == step(BRAKE, x1, x2, u, T_S)


def test_the_first_sample_counts_after_the_first_step() -> None:
    s = of_euler([2.0], ("k_m", "f_v"))
    assert s.shape == (1, 2, 2)
    assert s[0, 0].tolist() == pytest.approx([0.0, T_S * BRAKE.k_m * 2.0 / BRAKE.J], rel=1e-15)
    assert s[0, 1].tolist() == [0.0, 0.0]


def test_sensitivities_come_in_the_order_of_the_names_asked_for() -> None:
    currents = square(25, 2.0)
    everything = of_euler(currents)
    some = of_euler(currents, ("f_v", "k_1"))
    np.testing.assert_array_equal(some, everything[:, [3, 1]])


def test_currents_that_are_no_numbers_are_refused_with_their_place() -> None:
    with pytest.raises(UsageError, match="got nan at step 2"):
        euler_states(BRAKE, [1.0, 2.0, math.nan])
    with pytest.raises(UsageError, match="one row of currents"):
        of_euler(np.zeros((3, 2)))


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


def test_no_currents_give_the_start_and_no_samples() -> None:
    run = simulate(EXACT, Theta(BRAKE, (1.0, 2.0)), planned([]), T_S, ALL)
    assert run.states.tolist() == [[1.0, 2.0]]
    assert run.sensitivities.shape == (0, len(ALL), 2)


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
