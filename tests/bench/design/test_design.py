"""The search for optimal excitation: derivatives, criteria, bounds, and designs that can be judged by other means."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench import api
from emb_bench.config.bench import load_bench
from emb_bench.design import anneal
from emb_bench.design import search as search_module
from emb_bench.design.anneal import HOPELESS, PRICE, annealed, tracked
from emb_bench.design.problem import MARGIN, Problem, make_problem
from emb_bench.design.report import check
from emb_bench.design.search import search
from emb_bench.estimate.expected import IntervalCriterion
from emb_bench.information import symmetric
from emb_bench.information.criteria import Criterion, Name, distances
from emb_bench.information.fisher import Kind
from emb_bench.information.symmetric import Floats, unpack
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError
from tests.bench.design.bound import ceiling
from tests.benches import SENSOR_BENCH

BENCH = SENSOR_BENCH
TWO = ("k_m", "T_c")
GOALS = [Criterion("D"), Criterion("A"), Criterion("E")]


def problem(
    name: Name = "D", params: tuple[str, ...] = TWO, *, model: str = "exact", horizon: int = 120, returns: bool = True
) -> Problem:
    made = make_problem(BENCH, Criterion(name), params, model=model, returns=returns)
    return replace(made, horizon=horizon)


def out_and_back(horizon: int) -> Floats:
    return np.repeat([5.0, -4.0, -3.5, 4.5, -0.7], horizon // 5)


@st.composite
def information(draw: st.DrawFn) -> Floats:
    """Positive definite, of any scale."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    root = rng.normal(size=(4, 6)) * 10.0 ** rng.uniform(0.0, 2.0, (4, 1))
    return np.asarray(root @ root.T)


@pytest.mark.parametrize("model", ["euler", "exact", "stribeck", "lag"])
@pytest.mark.parametrize("goal", GOALS, ids=lambda goal: goal.name)
def test_the_gradient_of_a_criterion_is_that_of_finite_differences(model: str, goal: Criterion) -> None:
    p = make_problem(BENCH, goal, PARAMETER_NAMES, model=model)
    currents = out_and_back(100)
    design = p.design(currents)
    slopes = np.einsum("kij,ij->k", p.gradients(design, p.jacobian(design)), goal.gradient(design.matrix))
    for k in (0, 7, 33, 61, 90, 99):
        ahead, behind = currents.copy(), currents.copy()
        ahead[k] += 1e-4
        behind[k] -= 1e-4
        difference = (p.design(ahead).phi - p.design(behind).phi) / 2e-4
        assert slopes[k] == pytest.approx(difference, rel=2e-4, abs=1e-6 * np.abs(slopes).max())


@pytest.mark.parametrize("model", ["euler", "exact", "stribeck", "lag"])
def test_slopes_stay_finite_where_a_brake_creeps_across_rest_and_contact_for_long(model: str) -> None:
    p = make_problem(BENCH, GOALS[0], PARAMETER_NAMES, model=model)
    for currents in (np.zeros(500), np.tile([1e-9, -1e-9], 250), np.tile([0.3, 0.0, -0.3, 0.0], 125)):
        design = p.design(currents)
        jacobian = p.jacobian(design)
        assert np.isfinite(p.gradients(design, jacobian)).all()
        assert np.abs(jacobian[:, :2, :2]).max() < 10.0


@given(information(), st.sampled_from([0.0, 0.03, 0.3]))
@pytest.mark.parametrize("goal", GOALS, ids=lambda goal: goal.name)
def test_a_compiled_loop_has_the_same_phi(goal: Criterion, m: Floats, softness: float) -> None:
    found = symmetric.phi(goal.compiled, symmetric.pack(m), softness, np.empty((4, 4)))
    assert found == pytest.approx(float(goal.phi(m, softness)), rel=1e-6)


@given(information(), information())
@pytest.mark.parametrize("goal", GOALS, ids=lambda goal: goal.name)
def test_a_tangent_lies_above_its_criterion_everywhere(goal: Criterion, here: Floats, there: Floats) -> None:
    tangent = float(goal.phi(here)) + float((goal.gradient(here) * (there - here)).sum())
    assert float(goal.phi(there)) <= tangent + 1e-6 * (1.0 + abs(tangent))


@given(information(), st.floats(1e-3, 0.1))
def test_e_with_its_kinks_rounded_is_lower_by_no_more_than_four_equal_eigenvalues_make_it(
    m: Floats, soft: float
) -> None:
    lower = float(GOALS[2].phi(m) - GOALS[2].phi(m, soft))
    assert -1e-9 <= lower <= soft * math.log(4.0) + 1e-9
    for goal in GOALS[:2]:
        assert goal.phi(m, soft) == goal.phi(m)


@given(information(), information(), st.integers(0, 2**32 - 1))
def test_the_distance_of_two_informations_is_found_in_no_direction_larger_and_in_any_unit_the_same(
    one: Floats, other: Floats, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    found = distances(one[None], other)[0]
    v = rng.normal(size=(50, 4))
    ratios = np.log(np.einsum("ki,ij,kj->k", v, one, v) / np.einsum("ki,ij,kj->k", v, other, v))
    assert np.abs(ratios).max() <= found * (1.0 + 1e-6) + 1e-6
    assert found == pytest.approx(np.abs(np.log(scipy.linalg.eigvalsh(one, other))).max(), rel=1e-4, abs=1e-4)
    unit = 10.0 ** rng.uniform(-1.0, 1.0, 4)
    assert distances((one * np.outer(unit, unit))[None], other * np.outer(unit, unit))[0] == pytest.approx(
        found, rel=1e-4, abs=1e-4
    )


@pytest.mark.parametrize("model", ["euler", "exact"])
@pytest.mark.parametrize("params", [TWO, PARAMETER_NAMES, (*PARAMETER_NAMES, "J")], ids=len)
def test_the_population_and_a_single_design_are_simulated_alike(model: str, params: tuple[str, ...]) -> None:
    p = problem("A", params, model=model, horizon=300)
    genes = np.array(
        [[0.8, -0.3, 0.1, 0.1, -0.2, 1.0, 0.4, 0.2, 0.3], [-0.5, 0.9, -0.2, 0.2, 0.0, -0.1, 0.3, 0.3, 0.2]]
    )
    currents, matrices, phi, price = p.explore(genes)
    for i in range(2):
        design = p.design(currents[i])
        np.testing.assert_allclose(matrices[i], design.matrix, rtol=1e-9, atol=1e-9 * np.abs(design.matrix).max())
        assert design.phi == pytest.approx(phi[i], rel=1e-6)
        assert design.price == pytest.approx(price[i], abs=1e-9)


@pytest.mark.parametrize(("model", "near"), [("euler", 1e-6), ("exact", 0.1), ("stribeck", 0.1)])
def test_a_brake_that_is_tracked_reaches_the_speeds_of_a_design_again(model: str, near: float) -> None:
    p = problem("D", PARAMETER_NAMES, model=model, horizon=300)
    design = p.design(p.explore(np.array([[0.8, -0.3, 0.1, 0.1, -0.2, 1.0, 0.4, 0.2, 0.3]]))[0][0])
    tracks = tracked(p, design.states[None, 1:, 1])
    # Where a brake sticks, the current for a slow speed jumps: a tenth of what the velocity's noise is, then.
    np.testing.assert_allclose(tracks.speeds[0], design.states[1:, 1], rtol=0.0, atol=near)
    again = p.design(tracks.u[0])
    np.testing.assert_array_equal(again.states[1:, 1], tracks.speeds[0])
    assert again.phi == pytest.approx(float(p.criterion.phi(unpack(tracks.m[:, -1], 4))[0]))
    assert again.price == pytest.approx(tracks.price[0], abs=1e-9)


@pytest.mark.parametrize("model", ["euler", "exact"])
def test_an_annealing_tells_of_its_designs_what_their_currents_are_worth(model: str) -> None:
    p = problem("D", PARAMETER_NAMES, model=model, horizon=60)
    told = 0
    for seed in range(15):
        tracks, best = tracked(p, np.zeros((2, 60))), np.empty(60)
        rng = np.random.default_rng(seed)
        anneal.anneal(p.task, p.criterion.compiled, 20, rng, tracks, best)
        designs = [p.design(u) for u in tracks.u]
        for design, x, price in zip(designs, tracks.x, tracks.price, strict=True):
            np.testing.assert_array_equal(design.states[:, :2], x[:, :2])
            assert design.price == pytest.approx(price, abs=1e-9)
        for design, m in zip(designs, unpack(tracks.m[:, -1], 4), strict=True):
            unit = np.sqrt(np.diagonal(design.matrix))
            told += np.allclose(m, design.matrix, rtol=1e-6, atol=1e-9 * np.outer(unit, unit))
        lost = PRICE * abs(tracks.price[0] - tracks.price[1]) > HOPELESS
        told += lost  # one is dropped then, and its information is that of the design before
    assert told >= 30


@pytest.mark.parametrize("model", ["euler", "exact"])
def test_an_annealed_design_is_worth_more_than_rest_and_its_currents_keep_their_limit(model: str) -> None:
    p = problem(model=model, horizon=60)
    rest = p.design(np.zeros(60))
    currents = annealed(p, np.zeros(60), np.random.default_rng(0))
    end = p.design(currents)
    assert end.phi - PRICE * end.price > rest.phi - PRICE * rest.price
    assert np.abs(currents).max() <= p.box.current


def test_without_a_limit_in_reach_the_optimum_is_that_of_brute_force() -> None:
    p = problem("D", ("k_m",), model="euler", horizon=10, returns=False)
    best = max(p.design(6.0 * np.array(signs)).phi for signs in itertools.product((-1.0, 1.0), repeat=10))
    assert search(p, starts=2, seed=0).best.phi == pytest.approx(best, abs=1e-9)


def test_with_limits_in_reach_no_feasible_sequence_of_a_grid_is_better() -> None:
    p = replace(problem("D", ("k_1",), model="euler", returns=False), sample_time=0.005, horizon=6)
    designs = (p.design(np.array(u)) for u in itertools.product((-6.0, 0.0, 3.0, 6.0), repeat=6))
    best = max(design.phi for design in designs if design.feasible)
    assert search(p, starts=2, seed=0).best.phi > best


@settings(max_examples=2)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["D", "E"]), st.sampled_from(["euler", "exact"]), st.data())
def test_a_design_from_any_start_for_any_brake_keeps_the_limits_and_comes_home(
    seed: int, name: Name, model: str, data: st.DataObject
) -> None:
    shares = {n: data.draw(st.floats(0.5, 1.5), label=n) for n in PARAMETER_NAMES}
    nominal = BENCH.brake._asdict()
    brake = BENCH.brake._replace(**{n: share * nominal[n] for n, share in shares.items()})
    goal = Criterion(name)
    p = replace(make_problem(BENCH, goal, TWO, model=model, brake=brake), horizon=60)
    start = np.random.default_rng(seed).uniform(-20.0, 20.0, 60)
    best = search(p, starts=1, seed=seed, warm=[start]).best
    again = check(BENCH, p, "physical", best.currents, model)
    assert (again.limits_held, again.home) == (True, True)


def test_an_independent_integrator_finds_the_limits_held_and_the_brake_at_home() -> None:
    p = problem(horizon=80)
    best = search(p, starts=1, seed=3).best
    b, limits = p.brake, BENCH.limits
    parts, x1, x2 = 500, 0.0, 0.0
    h = p.sample_time / parts
    for u in best.currents:
        for _ in range(parts):  # semi-implicit steps of 2 us, friction as a torque budget
            free = x2 + h * (b.k_m * u - b.gamma * b.k_1 * max(x1, 0.0) - b.f_v * x2) / b.J
            x2 = math.copysign(max(0.0, abs(free) - h * b.T_c / b.J), free)
            x1 += h * x2
            assert limits.angle[0] - 0.02 <= x1 <= limits.angle[1] + 0.02
            assert abs(x2) <= limits.velocity + 0.2
    assert abs(x1) <= BENCH.shield.home_angle + 0.02
    assert abs(x2) <= BENCH.shield.home_velocity + 0.5
    assert np.abs(best.currents).max() <= limits.current
    assert (x1, x2) == pytest.approx(tuple(best.states[-1, :2]), abs=0.2)


def test_check_sees_a_limit_that_is_left_and_a_brake_that_is_not_home() -> None:
    again = check(BENCH, problem(), "physical", np.full(60, 6.0), "exact")
    assert not again.limits_held
    assert not again.home
    assert again.largest_speed > 500.0


def test_check_sees_where_the_brake_is_at_the_end_where_measurements_come_late() -> None:
    late, exact = (
        check(BENCH, problem(model=model), "physical", np.full(60, 2.0), model) for model in ("late", "exact")
    )
    assert replace(late, plant="exact") == exact


@pytest.mark.slow
def test_the_same_seed_finds_the_same_design_on_any_number_of_threads() -> None:
    p = problem(model="euler", horizon=40)
    one, two = (search(p, starts=2, seed=5, workers=workers) for workers in (1, 2))
    other = search(p, starts=2, seed=6, workers=1)
    np.testing.assert_array_equal(one.best.currents, two.best.currents)
    assert (one.best.currents != other.best.currents).any()


@pytest.mark.slow
@pytest.mark.parametrize(("params", "kind"), [(TWO, "physical"), (("f_v",), "weighted")])
def test_other_seeds_find_a_design_that_is_worth_the_same(params: tuple[str, ...], kind: Kind) -> None:
    goal = Criterion("D")
    p = replace(make_problem(BENCH, goal, params, model="euler", kind=kind), horizon=60)
    found = [search(p, starts=4, seed=seed).best.phi for seed in (0, 1)]
    assert abs(found[0] - found[1]) < 0.002 * len(params)  # 0.2 % of det M^(1/m)


def test_the_brake_need_not_come_home_when_it_is_not_asked_to() -> None:
    home, anywhere = (search(problem(horizon=60, returns=returns), starts=1, seed=0).best for returns in (True, False))
    assert abs(home.states[-1, 0]) <= BENCH.shield.home_angle
    assert anywhere.phi > home.phi
    assert abs(anywhere.states[-1, 0]) > BENCH.shield.home_angle


def test_a_brake_that_cannot_come_home_has_no_design() -> None:
    p = problem(horizon=20)
    with pytest.raises(UsageError, match="no design keeps the limits"):
        search(replace(p, box=p.box._replace(home_angle=-MARGIN)), starts=1, seed=0)


@pytest.mark.parametrize("name", ["D", "A", "E"])
def test_no_design_is_above_the_proved_bound(name: Name) -> None:
    goal = Criterion(name)
    p = make_problem(BENCH, goal, PARAMETER_NAMES)
    journeys = np.random.default_rng(2).uniform(-1.0, 1.0, (200, 10))
    _, _, phi, price = p.explore(np.hstack([journeys, np.ones((200, 5))]))
    assert (price == 0.0).sum() > 50
    assert phi[price == 0.0].max() < ceiling(p, goal)


@pytest.fixture
def _few(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search for the interval of few designs, in this process."""
    monkeypatch.setattr(search_module, "FEW", 60)
    monkeypatch.setattr(search_module, "shared_out", lambda work, pieces, *_: enumerate(map(work, pieces)))


@pytest.mark.usefixtures("_few")
@pytest.mark.parametrize("name", ["T", "I", "T_c"])
def test_a_design_for_the_interval_is_worth_what_an_estimate_is_expected_to_tell(name: str) -> None:
    bench = load_bench()
    p = replace(make_problem(bench, IntervalCriterion(name), PARAMETER_NAMES), horizon=120)
    told: list[str] = []
    found = search(p, starts=2, seed=1, told=told.append)
    assert told == ["start 1 of 2 done", "start 2 of 2 done"]
    assert len(told) == search_module.steps_of(p.goal, 2)
    assert not found.interrupted
    interval = api.interval(api.fisher_information(found.best.currents))
    deviations = interval.repeatability if name == "I" else interval.between_runs
    wanted = -2.0 * np.log(deviations[2:3] if name == "T_c" else deviations).sum()
    assert found.best.phi == pytest.approx(float(wanted), rel=1e-9)
    assert found.best.feasible
    assert max(p.beyond(found.best)) <= MARGIN
    assert found.best.phi == max(design.phi for design in found.designs)
    assert check(bench, p, "physical", found.best.currents, "exact").value == found.best.phi


@pytest.mark.usefixtures("_few")
def test_a_search_for_the_interval_goes_on_from_the_table_of_another_brake() -> None:
    bench = load_bench()
    first = replace(make_problem(bench, IntervalCriterion("T"), PARAMETER_NAMES), horizon=120)
    other = replace(first, brake=bench.brake._replace(T_c=0.7 * bench.brake.T_c))
    begun = search(first, starts=3, seed=1)
    assert begun.genes is not None
    _, _, (as_it_is,), (price,) = other.explore(begun.genes[None])
    assert price == 0.0
    told: list[str] = []
    found = search(other, starts=1, seed=1, warm=[begun.genes], told=told.append)
    assert told == ["start 1 of 2 done", "start 2 of 2 done"]
    assert found.best.phi > as_it_is
    assert found.best.phi > search(other, starts=1, seed=1).best.phi


@pytest.mark.usefixtures("_few")
def test_an_interrupted_search_keeps_the_best_design_so_far() -> None:
    """As soon as one can keep the limits: a coarse one for T, a polished one for D."""
    of_interval = replace(make_problem(load_bench(), IntervalCriterion("T"), PARAMETER_NAMES), horizon=120)

    def told_until(last: str) -> Callable[[str], None]:
        def told(done: str) -> None:
            if done.startswith(last):
                raise KeyboardInterrupt

        return told

    of_information = problem(horizon=40)
    for p, last in ((of_interval, "start 1 of 2"), (of_information, "round 1")):
        found = search(p, starts=2, seed=1, told=told_until(last))
        assert found.interrupted
        assert found.best.feasible
        assert found.best.phi == max(design.phi for design in found.designs)
    with pytest.raises(KeyboardInterrupt):
        search(of_information, starts=2, seed=1, told=told_until("start 1"))


def test_currents_that_say_nothing_are_the_worst_design_for_the_interval() -> None:
    p = replace(make_problem(BENCH, IntervalCriterion("T"), PARAMETER_NAMES), horizon=60)
    assert p.design(np.zeros(60)).phi == -np.inf


@pytest.mark.parametrize(
    ("name", "more", "words"),
    [("T", {"kind": "weighted"}, "physical"), ("k_1", {"params": TWO}, "k_1 among the parameters")],
)
def test_a_design_for_the_interval_is_refused_where_there_is_none(name: str, more: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        make_problem(BENCH, IntervalCriterion(name), **{"params": PARAMETER_NAMES, **more})
