"""Excitations against each other: the runs, the statistics and the verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from emb_bench.estimate import records
from emb_bench.excitation.reference import Excitation, Response, excitation, parse_excitation, run_excitation
from emb_bench.information.fisher import fisher
from emb_bench.numbers import Score
from emb_bench.sim.node import REST_TIME, REST_TRAVEL, BrakeNode
from emb_runtime.can.e2e import COUNTER_MODULUS
from emb_runtime.can.messages import Layout, StopReason
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, load_bench, parse_bench, shipped_bench_text
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.records import CurrentCommand, NodeState
from studies.comparison import candidates as candidates_module
from studies.comparison import trials
from studies.comparison.candidates import Candidate, read_candidates
from studies.comparison.comparison import Comparison, ComparisonPlan, efficiency
from studies.comparison.conclusion import against, conclude, interval, number
from studies.comparison.intervals import mean, median, rate, ratio, resampling, root_mean_square, score, upper
from studies.comparison.report import document, markdown, text
from studies.comparison.trials import (
    Job,
    Played,
    brake_of,
    end_of,
    fields,
    information_at,
    noise_of,
    record_of,
    time_to_rest,
    work,
)
from tests.actors import Leaky, leaky_actor

BENCH = load_bench()
EXACT = BENCH.plant("exact")
NOTHING = "step:amplitude=0"


def job(names: Sequence[str], **changes: Any) -> Job:
    chosen = read_candidates(names, BENCH, PARAMETER_NAMES)
    made = Job(BENCH.text, chosen, "exact", "exact", PARAMETER_NAMES, "envelope", 3, 0, 1, optimum=False)
    return made._replace(**changes)


@pytest.fixture(scope="module")
def played() -> Played:
    """An actor, an excitation and one that does nothing, on one brake."""
    return work(job(["actor", "step", NOTHING], draws=3))


# --- The runs ---------------------------------------------------------------------------------------------------------


def test_the_same_draw_is_the_same_noise_and_another_one_is_not() -> None:
    first = noise_of(BENCH, 1, 2, 3)
    assert first.shape == (BENCH.timing.horizon + 1, 2)
    assert np.array_equal(first, noise_of(BENCH, 1, 2, 3))
    for other in ((0, 2, 3), (1, 3, 3), (1, 2, 0), (1, 3, 2)):
        assert not np.array_equal(first, noise_of(BENCH, *other))
    scaled = first / [BENCH.noise.angle, BENCH.noise.velocity]
    assert stats.kstest(scaled.ravel(), "norm").pvalue > 0.001


def test_brakes_are_uniform_in_their_ranges_and_what_is_known_is_nominal() -> None:
    ranges = BENCH.range_set("viscous-stiffness")
    drawn = np.array([brake_of(BENCH, ranges, 5, number) for number in range(200)])
    spread = dict(zip(BENCH.brake._fields, drawn.T, strict=True))
    for name, (low, high) in {"f_v": (1e-5, 5e-5), "k_1": (25.0, 50.0)}.items():
        assert stats.kstest((spread[name] - low) / (high - low), "uniform").pvalue > 0.001
    for name in ("J", "gamma", "k_m", "T_c"):
        assert set(spread[name].tolist()) == {getattr(BENCH.brake, name)}


def test_every_candidate_meets_the_same_brake_and_the_same_noise_on_every_plant(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    met: list[tuple[Any, ...]] = []

    def watched(bench: Bench, excited: Excitation, mechanics: Any, p: Any, **options: Any) -> Response:
        met.append((excited.name, p, options["shielded"], options["noise"]))
        return run_excitation(bench, excited, mechanics, p, **options)

    monkeypatch.setattr(trials, "run_excitation", watched)
    work(job(["square", "step"], draws=2))
    work(job(["square", "step"], draws=2, plant="euler"))
    assert len({p for _, p, _, _ in met}) == 1
    shielded = [noise for _, _, guarded, noise in met if guarded]
    assert len(shielded) == 8
    for noise in shielded[2::2]:
        assert np.array_equal(noise, shielded[0])
    for noise in shielded[3::2]:
        assert np.array_equal(noise, shielded[1])
    free = [(name, noise) for name, _, guarded, noise in met if not guarded]
    assert [name for name, _ in free] == ["square", "step"] * 2  # once on each brake
    assert all(np.array_equal(noise, shielded[0]) for _, noise in free)


def test_the_information_is_that_of_plain_python_and_the_truth_costs_what_the_noise_is() -> None:
    p = brake_of(BENCH, BENCH.range_set("envelope"), 3, 0)
    noise = noise_of(BENCH, 3, 0, 0)
    response = run_excitation(BENCH, excitation("step", BENCH), EXACT.mechanics, p, shielded=True, noise=noise)
    record = record_of(BENCH, response, noise)
    got, chi2 = information_at(BENCH, EXACT, records.EstimationProblem(("T_c", "k_m", "f_v", "k_1")), p, record)
    expected = fisher(
        BENCH,
        p,
        response.currents,
        kind="physical",
        normalise_by="true",
        plant=EXACT,
        params=("T_c", "k_m", "f_v", "k_1"),
    )
    np.testing.assert_allclose(got, expected.matrix, rtol=1e-6)
    assert chi2 == pytest.approx(np.sum((noise[1:] / [BENCH.noise.angle, BENCH.noise.velocity]) ** 2))


def test_an_estimate_from_a_run_lies_where_its_bound_says(played: Played) -> None:
    runs = played.table[:2]
    assert runs["told"].all()
    assert not runs["missed"].any()
    assert not runs["stopped"].any()
    assert runs["home"].all()
    assert (np.abs(runs["error"]) < 5.0 * runs["bound"]).all()
    assert (runs["bound"] < 1e-2).all()
    assert (runs["log_det"] > 90.0).all()
    assert math.isnan(played.optimum)


def test_what_does_nothing_tells_nothing(played: Played) -> None:
    runs = played.table[2]
    assert not runs["told"].any()
    assert np.isinf(runs["bound"]).all()
    assert (runs["log_det"] == -math.inf).all()
    assert (runs["lambda_min"] == 0.0).all()
    assert (runs["speed"] == 0.0).all()
    # The search ends where it began, at the nominal brake.
    p = brake_of(BENCH, BENCH.range_set("envelope"), 3, 0)
    expected = [getattr(BENCH.brake, name) / getattr(p, name) - 1.0 for name in PARAMETER_NAMES]
    np.testing.assert_allclose(runs["error"], np.tile(expected, (3, 1)), atol=1e-9)


def test_another_brake_than_the_model_s_raises_the_alarm() -> None:
    runs = work(job(["step"], plant="stribeck")).table
    assert runs["alarm"].all()
    assert (np.abs(runs["error"]) > 10.0 * runs["bound"]).any()


def test_a_run_ends_at_the_sample_at_which_the_node_stops_the_brake(layout: Layout) -> None:
    lag = BENCH.plant("lag")
    for name in ("square:period=0.36", "square:period=0.02", "step:amplitude=-6"):
        response = run_excitation(BENCH, parse_excitation(name, BENCH), lag.mechanics, BENCH.brake, shielded=False)
        node = BrakeNode(BENCH, layout, BENCH.brake, lambda: (0.0, 0.0, 0.0), lag)
        frames, samples = node.tick(), 0
        while samples < BENCH.timing.horizon and node.state is not NodeState.STOPPING:
            answers = layout.decode_angle(frames[0]).counter
            asked = CurrentCommand(samples % COUNTER_MODULUS, answers, float(response.currents[samples]), True)
            node.receive(layout.encode_command(asked))
            frames, samples = node.tick(), samples + 1
        assert end_of(BENCH, response) == samples
        assert response.kept == (node.stop_reason is not StopReason.LIMIT)


def test_a_run_that_leaves_the_limits_is_cut_there_is_not_home_and_is_not_estimated() -> None:
    runs = work(job(["square:period=0.36", NOTHING], plant="lag", seed=0)).table
    cut, whole = runs[0, 0], runs[1, 0]
    assert (cut["stopped"], whole["stopped"]) == (True, False)
    assert not cut["home"]
    assert not cut["told"].any()
    assert np.isnan(cut["error"]).all()
    assert np.isnan(cut["bound"]).all()
    assert cut["log_det"] == -math.inf
    assert np.isfinite(whole["error"]).all()
    # What is told of its motion ends with the one sample outside, and the time with the node's stop from there.
    p, noise = brake_of(BENCH, BENCH.range_set("envelope"), 0, 0), noise_of(BENCH, 0, 0, 0)
    lag, excited = BENCH.plant("lag").mechanics, parse_excitation("square:period=0.36", BENCH)
    states = run_excitation(BENCH, excited, lag, p, shielded=True, noise=noise).states
    (low, high), speed = BENCH.limits.angle, BENCH.limits.velocity
    end = next(k for k, (x1, x2) in enumerate(states) if not low <= x1 <= high or abs(x2) > speed)
    assert end < BENCH.timing.horizon
    assert (cut["low"], cut["high"]) == (states[: end + 1, 0].min(), states[: end + 1, 0].max())
    assert cut["speed"] == np.abs(states[: end + 1, 1]).max()
    assert cut["seconds"] == pytest.approx(1e-3 * end + time_to_rest(BENCH, lag, p, states[end]))


@pytest.mark.slow
def test_the_best_design_for_a_known_brake_tells_more_than_any_run_on_it() -> None:
    short = shipped_bench_text().replace("horizon     = 500", "horizon     = 60")
    found = work(job(["step"], bench=short, ranges="viscous", params=("f_v",), optimum=True))
    assert found.table["log_det"].max() < found.optimum < found.table["log_det"].max() + 20.0


def test_a_brake_that_rests_is_watched_for_the_node_s_time_of_rest() -> None:
    rested = time_to_rest(BENCH, EXACT.mechanics, BENCH.brake, np.zeros(2))
    assert rested == pytest.approx(REST_TIME)


def test_a_brake_that_is_let_go_comes_to_rest_when_friction_has_stopped_it() -> None:
    bench = parse_bench(shipped_bench_text().replace('stop             = "damped"', 'stop = "freewheel"'), "test")
    assert bench.node.stop == "freewheel"
    p, speed = bench.brake, 40.0
    got = time_to_rest(bench, EXACT.mechanics, p, np.array([-1.0, -speed]))  # away from contact: no spring
    stops = p.J / p.f_v * math.log1p(p.f_v * speed / p.T_c)
    creeping = math.sqrt(2.0 * REST_TRAVEL * p.J / p.T_c)  # the last bit of the way already counts as rest
    assert stops + REST_TIME - creeping - 2e-3 <= got <= stops + REST_TIME + 2e-3


def test_an_actor_with_a_state_begins_anew_in_each_run_and_is_told_what_acted() -> None:
    excited, leaky = Candidate("leaky.onnx", "", onnx=leaky_actor(BENCH)).built(BENCH), Leaky()
    runs = [run_excitation(BENCH, excited, EXACT.mechanics, BENCH.brake, shielded=True) for _ in range(2)]
    assert runs[0].wanted.tolist() == runs[1].wanted.tolist()
    leaky.begin()
    acted = [0.0, *runs[0].currents[:-1].tolist()]
    assert runs[0].wanted == pytest.approx([leaky.act(0.0, 0.0, k, current) for k, current in enumerate(acted)])


def test_an_actor_that_wants_no_finite_current_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken:
        def begin(self) -> None:
            pass

        def act(self, angle: float, velocity: float, step: float, applied_current: float) -> float:
            return math.nan if step == 7 else 1.0

    chosen = (Candidate("broken.onnx", "", learned=True, onnx=b"x"),)
    monkeypatch.setattr(candidates_module, "load_policy", lambda data, bench: Broken())
    with pytest.raises(PolicyRefusedError, match=r"broken\.onnx: expected a finite current at sample 7, got nan"):
        work(Job(BENCH.text, chosen, "exact", "exact", PARAMETER_NAMES, "envelope", 0, 0, 1, optimum=False))


# --- The statistics ---------------------------------------------------------------------------------------------------


def test_statistics_of_runs_are_numpy_s() -> None:
    values = np.random.default_rng(0).standard_normal((5, 4)) ** 2
    indices = resampling(5, 0)
    for statistic, expected in (
        (mean, np.mean(values)),
        (median, np.median(values)),
        (upper, np.percentile(values, 95.0)),
        (root_mean_square, math.sqrt(np.mean(values**2))),
    ):
        found = score(values, statistic, indices)
        assert found.value == pytest.approx(expected)
        assert found.low <= found.value <= found.high


def test_the_interval_of_a_mean_is_the_closed_form_s_over_brakes_not_over_runs() -> None:
    brakes, draws = 400, 10
    values = np.repeat(np.random.default_rng(1).standard_normal((brakes, 1)), draws, axis=1)
    found = score(values, mean, resampling(brakes, 2))
    half = 1.96 * values[:, 0].std() / math.sqrt(brakes)
    assert found.high - found.low == pytest.approx(2.0 * half, rel=0.1)


def test_a_constant_factor_between_two_is_found_without_any_spread() -> None:
    theirs = np.exp(2.0 * np.random.default_rng(3).standard_normal((30, 5)))
    found = ratio(0.4 * theirs, theirs, median, resampling(30, 0))
    assert found == pytest.approx(Score(0.4, 0.4, 0.4))
    assert score(theirs, median, resampling(30, 0)).high > 1.2 * score(theirs, median, resampling(30, 0)).low


def test_a_ratio_to_nothing_is_infinite_and_of_nothing_to_nothing_no_number() -> None:
    zero, one = np.zeros((3, 2)), np.ones((3, 2))
    assert ratio(one, zero, median, resampling(3, 0)) == Score(math.inf, math.inf, math.inf)
    assert all(map(math.isnan, ratio(zero, zero, median, resampling(3, 0))))


@pytest.mark.parametrize("brakes", [2, 17, 100])
@pytest.mark.parametrize("always", [False, True])
def test_what_happens_never_or_always_has_clopper_and_pearson_s_interval(brakes: int, always: bool) -> None:
    found = rate(np.full((brakes, 3), always), resampling(brakes, 0))
    exact = stats.binomtest(brakes if always else 0, brakes).proportion_ci(method="exact")
    assert found.value == float(always)
    assert (found.low, found.high) == pytest.approx((exact.low, exact.high))


def test_draws_on_one_brake_do_not_make_a_rate_more_certain() -> None:
    happened = np.random.default_rng(4).random((200, 1)) < 0.3
    found = rate(np.repeat(happened, 50, axis=1), resampling(200, 5))
    share = float(happened.mean())
    assert found.value == pytest.approx(share)
    assert found.high - found.low == pytest.approx(2 * 1.96 * math.sqrt(share * (1 - share) / 200), rel=0.15)


def test_efficiency_is_the_geometric_mean_of_variances_and_nothing_has_none() -> None:
    variances = np.array([0.5, 0.25])
    information = np.diag(1.0 / variances)
    best = np.eye(2) * 16.0
    log_dets = [np.linalg.slogdet(m)[1] for m in (information, best)]
    expected = math.sqrt(np.prod((1.0 / 16.0) / variances))
    assert efficiency(np.array(log_dets[0]), np.array(log_dets[1]), 2) == pytest.approx(expected)
    assert efficiency(np.array(-math.inf), np.array(3.0), 2) == 0.0
    assert efficiency(np.array(-math.inf), np.array(-math.inf), 2) == 0.0


# --- The verdict ------------------------------------------------------------------------------------------------------


def made(errors: NDArray[np.float64], learned: bool = True, told: NDArray[np.bool_] | None = None) -> Comparison:
    """A comparison in f_v and T_c with these errors, shape (candidates, 2), times a spread that all brakes share."""
    brakes, draws = 40, 3
    table = np.zeros((len(errors), brakes, draws), np.dtype(fields(2)))
    spread = np.exp(np.random.default_rng(0).standard_normal((brakes, draws)))
    table["error"] = errors[:, None, None, :] * spread[:, :, None]
    table["bound"], table["covered"] = 1e-5, True
    table["told"] = True if told is None else told[:, None, None, :]
    table["home"], table["log_det"] = True, 90.0
    names = ["actor", *(f"plain{i}" for i in range(1, len(errors)))]
    chosen = tuple(Candidate(n, "made", learned and i == 0, ("f_v",) if i == 0 else ()) for i, n in enumerate(names))
    asked = ComparisonPlan(("f_v", "T_c"), "viscous", ("exact",), "exact", brakes, draws, 0, 0)
    return Comparison(BENCH, asked, chosen, {"exact": table}, np.full(brakes, math.nan))


def stopped_run(size: int) -> NDArray[np.void]:
    """What is kept of a run that was stopped."""
    row = np.zeros((), np.dtype(fields(size)))
    row["error"], row["bound"], row["log_det"], row["stopped"] = math.nan, math.nan, -math.inf, True
    return row


@pytest.mark.parametrize(
    ("errors", "answer"),
    [
        ([[1.0, 1.0], [2.0, 2.0], [1.5, 3.0]], "Yes"),
        ([[1.0, 1.0], [0.5, 1.0], [3.0, 3.0]], "No: plain1 needs no training"),
        ([[1.0, 1.0], [0.5, 1.0], [1.0, 0.5]], "No: plain1, plain2 need no training"),
        ([[1.0, 1.0], [2.0, 0.5], [2.0, 2.0]], "Only for f_v"),
        ([[1.0, 1.0], [2.0, 0.5], [0.5, 2.0]], "Not shown"),
    ],
)
def test_the_answer_follows_from_the_pairs(errors: list[list[float]], answer: str) -> None:
    found = conclude(made(np.array(errors)))
    assert f"differ in f_v? {answer}" in found[-1]


def test_what_an_actor_was_not_trained_for_is_said() -> None:
    (actor,) = read_candidates(["actor"], BENCH, PARAMETER_NAMES)
    assert (actor.learned, actor.trained) == (True, PARAMETER_NAMES)
    c = made(np.ones((2, 2)))
    assert not any("was trained on" in line for line in conclude(c))
    wider = replace(c, asked=replace(c.asked, ranges="viscous-stiffness"))
    assert "actor was trained on brakes that differ in f_v; here they differ in k_1 as well." in conclude(wider)


def test_without_anything_learned_nobody_asks_whether_learning_was_worth_it() -> None:
    assert not any("worth it" in line for line in conclude(made(np.ones((3, 2)), learned=False)))


def test_a_pair_is_said_in_words_with_its_interval() -> None:
    c = made(np.array([[1.0, 1.0], [2.5, 1.0]]))
    assert [pair.sign for pair in c.pairs] == [-1, 0]
    said = against(c)
    assert said == ["actor against plain1: better in f_v (0.4 [0.4, 0.4] x); not told apart in T_c (1 [1, 1] x)"]


def test_errors_and_information_are_of_the_brakes_on_which_no_run_was_stopped() -> None:
    c = made(np.array([[1.0, 1.0], [0.5, 3.0]]))
    c.tables["exact"][1, :10, 1] = stopped_run(2)  # one draw of three, on a quarter of the brakes
    (first, other), left = c.standings["exact"], c.tables["exact"][:, 10:]
    assert (first.stopped.value, other.stopped.value) == (0.0, 0.25)
    assert other.parameters[1].median.value == pytest.approx(np.median(np.abs(left["error"][1, :, :, 1])))
    assert other.parameters[1].upper.value == pytest.approx(np.percentile(np.abs(left["error"][1, :, :, 1]), 95.0))
    assert (other.parameters[1].told, other.log_det, other.of_best.value) == (0.75, 90.0, 1.0)
    assert other.parameters[1].bound == 1e-5
    assert first.parameters[1].median.value == pytest.approx(np.median(np.abs(c.errors("exact", 0, 1))))
    assert [pair.ratio for pair in c.pairs] == [pytest.approx((2.0, 2.0, 2.0)), pytest.approx((1 / 3, 1 / 3, 1 / 3))]
    limits = next(line for line in conclude(c) if line.startswith("Limits: "))
    assert limits.startswith("Limits: under the shield the bench stops runs of plain1 on 25 % of 40 brakes; without it")


def test_who_is_always_stopped_has_no_errors_and_is_no_better_for_that() -> None:
    c = made(np.array([[1.0, 1.0], [2.0, 2.0]]))
    c.tables["exact"][1] = stopped_run(2)
    other = c.standings["exact"][1]
    assert (other.stopped.value, other.home) == (1.0, 0.0)
    assert all(math.isnan(v) for v in (other.log_det, other.of_best.value, other.parameters[0].median.value))
    assert [pair.sign for pair in c.pairs] == [-1, -1]
    rows = [" ".join(line.split()[1:]) for line in text(c).splitlines() if line.startswith("plain1  ")]
    information, first, second = (row for row in rows[1:] if row.startswith("-"))
    assert information == "- - - - - -"
    assert first == second == "- - - - - 0 %"  # of each parameter
    assert "nan" not in text(c)
    assert "actor is stopped on every brake" not in " ".join(conclude(c))
    c = made(np.array([[1.0, 1.0], [2.0, 2.0]]))
    c.tables["exact"][0] = stopped_run(2)
    assert "Information: actor is stopped on every brake." in conclude(c)
    lag = replace(
        c, tables={"exact": made(np.ones((2, 2))).tables["exact"], "lag": np.full((2, 40, 1), stopped_run(2))}
    )
    said = "under the shield the bench stops runs of actor on 100 %, plain1 on 100 % of them."
    assert f"On lag brakes nothing is estimated: {said}" in conclude(lag)


def test_what_a_wrong_model_costs_is_said_and_who_left_the_limits() -> None:
    c = made(np.array([[1e-5, 1e-4], [2e-5, 2e-4]]))
    wrong = c.tables["exact"][:, :, :1].copy()
    wrong["error"] = np.array([[30e-5, 50e-4], [40e-5, 80e-4]])[:, None, None, :]
    wrong["alarm"] = True
    wrong[1, :30] = stopped_run(2)
    said = conclude(replace(c, tables={**c.tables, "lag": wrong}))
    spread = float(np.median(c.tables["exact"]["error"][0, :, :, 0])) / 1e-5
    low, high = number(20.0 / spread, 2), number(50.0 / spread, 2)
    assert (
        "On lag brakes, estimated as exact, the alarm is raised in all runs; the median error is "
        f"{low} to {high} x that on exact ones, by excitation and parameter, on brakes where it is never stopped; "
        "under the shield the bench stops runs of plain1 on 75 % of them."
    ) in said
    untold = replace(c, tables={"exact": c.tables["exact"].copy(), "lag": wrong})
    untold.tables["exact"]["told"] = False
    assert any(line.startswith("On lag brakes") and "median error" not in line for line in conclude(untold))


def test_who_tells_nothing_is_not_ahead_by_where_its_search_began() -> None:
    told = np.array([[True, True], [False, True]])
    c = made(np.array([[1.0, 1.0], [1e-9, 1.0]]), told=told)
    assert c.pairs[0].sign == -1
    assert "f_v (which only one of them tells)" in against(c)[0]
    neither = made(np.array([[1.0, 1.0], [1e-9, 1.0]]), told=np.array([[False, True], [False, True]]))
    assert neither.pairs[0].sign == 0
    assert "f_v: nobody tells it." in conclude(neither)


def test_every_table_fits_a_terminal_and_the_page_says_the_verdict_first(played: Played) -> None:
    names = ("actor", "step", NOTHING)
    chosen = read_candidates(names, BENCH, PARAMETER_NAMES)
    asked = ComparisonPlan(PARAMETER_NAMES, "envelope", ("exact",), "exact", 2, 3, 1, 0)
    table = np.stack([played.table, played.table], axis=1)
    c = Comparison(BENCH, asked, chosen, {"exact": table}, np.array([101.0, math.nan]))
    said = text(c)
    assert max(map(len, said.splitlines())) <= 120
    nothing = [line for line in said.splitlines() if line.startswith(NOTHING)]
    assert any("-inf" in line for line in nothing)
    assert any(line.endswith(" 0 %") for line in nothing)
    page = markdown(c, "python -m studies.comparison", 12.3, 2)
    assert page.index("## Verdict") < page.index("## Tables")
    assert "`python -m studies.comparison`, 12 s with 2 processes" in page
    got = document(c)
    told = got["plants"]["exact"][NOTHING]["parameters"]["f_v"]["told"]
    assert (told, got["plants"]["exact"]["step"]["parameters"]["f_v"]["told"]) == (0.0, 1.0)
    best = np.exp((played.table["log_det"][1] - 101.0) / 4.0).mean()
    assert got["plants"]["exact"]["step"]["d_efficiency_of_known"]["value"] == pytest.approx(best)


@pytest.mark.parametrize(
    ("value", "expected"),
    [(0.123456, "0.123"), (12345678.0, "1.23e+07"), (1234.5, "1230"), (math.inf, "inf"), (math.nan, "-"), (0.0, "0")],
)
def test_numbers_are_short(value: float, expected: str) -> None:
    assert number(value) == expected


def test_an_interval_of_nothing_is_a_dash() -> None:
    assert interval(Score(math.nan, math.nan, math.nan)) == "-"
    assert interval(Score(0.4, 0.3, 0.6)) == "0.4 [0.3, 0.6]"


# --- What is refused --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"params": ("k_m", "T_c", "f_v")}, "k_1 varies in the ranges 'envelope' and is not estimated"),
        ({"params": ("J",)}, "--params: expected some of k_m"),
        ({"params": ()}, "--params: expected some of k_m"),
        ({"plants": ("jitter",)}, "'jitter' has instruments that are not played here: expected some of euler, exact"),
        ({"plants": ("exact", "exact")}, "a plant is named twice"),
        ({"plants": ("nope",)}, "nope"),
        ({"ranges": "nope"}, "nope"),
    ],
)
def test_what_cannot_be_answered_is_refused(change: dict[str, Any], said: str) -> None:
    given = {"params": PARAMETER_NAMES, "ranges": "envelope", "plants": ("exact",), **change}
    with pytest.raises(UsageError, match=said.replace("(", r"\(")):
        ComparisonPlan(model="exact", brakes=2, draws=1, known=0, seed=0, **given).check(BENCH)
