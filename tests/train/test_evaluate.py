"""What an evaluation says, against numbers that are computed another way; and what the command does with it."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats
from numpy.typing import NDArray

from emb_bench import api
from emb_bench.config.bench import load_bench, parse_bench
from emb_bench.design.problem import Problem, make_problem
from emb_bench.excitation import parse_excitation, run_excitation
from emb_bench.information.criteria import Criterion
from emb_bench.parallel import processes
from emb_runtime.config.bench import PARAMETER_NAMES, shipped_bench_text
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.policy.policy import load_policy
from emb_train import optimum
from emb_train.cli import main
from emb_train.closed_loop import Batch, Conditions
from emb_train.evaluate import (
    Settings,
    Subject,
    evaluate,
    evaluation_document,
    evaluation_text,
    open_subject,
    references,
)
from emb_train.optimum import followed, optima, searchable
from emb_train.play import MEASURES, STEP, Draw, fresh_draws, mean_score, of_actor, of_law, play
from emb_train.training import ONNX, PLAN

from tests.bench.flows import fisher  # isort: skip
from tests.benches import SENSOR_BENCH
from tests.commands import refused
from tests.train.trainings import HORIZON, constant

BENCH = load_bench()
SHORT = parse_bench(shipped_bench_text().replace("horizon     = 500", f"horizon     = {HORIZON}"), "short")
WIDE = BENCH.range_set("pm50")
PHYSICAL = Conditions(information="physical")


def quiet(line: str) -> None:
    assert "\n" not in line


def run(*arguments: object) -> int:
    return main(["evaluate", *map(str, arguments), "--draws", "4", "--plant", "euler"])


def test_what_was_played_has_the_information_that_plain_python_computes_from_the_same_currents() -> None:
    draws = fresh_draws(WIDE, seed=5, count=3)
    excited = parse_excitation("square:period=0.2,amplitude=3", BENCH)
    for name in ("euler", "exact"):
        outcome = play(BENCH, WIDE, PARAMETER_NAMES, of_law(excited.law), draws, name, PHYSICAL)
        plant = BENCH.plant(name)
        for i, draw in enumerate(draws):
            rng = np.random.default_rng(draw.seed)
            rng.uniform(WIDE.low, WIDE.high)
            noise = rng.standard_normal((501, 2)) * [BENCH.noise.angle, BENCH.noise.velocity]
            played = run_excitation(BENCH, excited, plant.mechanics, draw.brake, shielded=True, noise=noise)
            found = fisher(BENCH, draw.brake, played.currents, kind="physical", plant=plant)
            np.testing.assert_allclose(outcome.matrices[i], found.matrix, rtol=1e-6)
            assert outcome.home[i] == played.home
            assert outcome.violated[i] == (not played.kept)


def test_a_draw_depends_on_the_seed_and_its_number_alone() -> None:
    few, many = fresh_draws(WIDE, 3, 2), fresh_draws(WIDE, 3, 9)
    assert [d.brake for d in few] == [d.brake for d in many[:2]]
    short = SHORT.range_set("pm50")
    first, second = (play(SHORT, short, ("k_1", "f_v"), constant(6.0), d) for d in (few, many))
    np.testing.assert_array_equal(first.matrices, second.matrices[:2])


def test_an_experiment_that_leaves_the_limits_keeps_what_it_had_and_is_not_home() -> None:
    p = BENCH.brake  # its braking is outside of what the shield covers, its motor is not
    strong = Draw(0, p._replace(k_m=0.55 * p.k_m, k_1=-2.0 * p.k_1))
    outcome = play(BENCH, WIDE, ("f_v",), constant(6.0), [strong])
    batch = Batch(BENCH, WIDE, ("f_v",), 1)
    batch.begin(0, np.random.default_rng(0), strong.brake)
    before = 0.0
    while not batch.experiments.violated[0]:
        before = float(batch.newest(batch.experiments.m)[0, 0])
        batch.advance(np.array([6.0]))
    assert (outcome.violated[0], outcome.home[0], outcome.matrices[0, 0, 0]) == (True, False, before)


def test_policies_that_cannot_be_played_are_refused(tmp_path: Path) -> None:
    with pytest.raises(PolicyRefusedError):
        play(SHORT, WIDE, ("f_v",), lambda seen: np.where(seen[:, STEP] == 7, np.nan, 1.0), fresh_draws(WIDE, 0, 1))
    path = tmp_path / "empty.onnx"
    path.touch()
    with pytest.raises(PolicyRefusedError, match=str(path)):
        open_subject(str(path), None)


def test_a_plan_has_its_ranges_with_it_and_the_bench_of_its_training_beside_it(
    finished_speeds: Path, tmp_path: Path
) -> None:
    trained, own = open_subject(str(finished_speeds), None), open_subject(str(finished_speeds / PLAN), None)
    assert (own.bench, own.ranges) == (trained.bench, trained.ranges)
    for given in (finished_speeds / PLAN, finished_speeds):
        with pytest.raises(UsageError, match="--bench"):
            open_subject(str(given), finished_speeds / "bench.toml")
    alone = shutil.copy(finished_speeds / PLAN, tmp_path)
    assert open_subject(str(alone), finished_speeds / "bench.toml").ranges == "pm50"
    assert open_subject(str(alone), None).bench == BENCH


def test_a_folder_without_a_policy_is_refused(finished_speeds: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(finished_speeds, tmp_path / "run")
    (folder / ONNX).unlink()
    with pytest.raises(UsageError, match=ONNX):
        open_subject(str(folder), None)


def test_the_measures_are_those_of_a_matrix_worked_out_by_hand_and_their_shares_nats_or_ratios() -> None:
    m = np.array([[[88.0, 30.0], [30.0, 8.0]]])  # with the prior [[100, 30], [30, 20]]: eigenvalues 110 and 10
    values = {name: float(MEASURES[name].values(m)[0]) for name in ("D", "A", "E", "weighted")}
    assert values["D"] == pytest.approx(math.log(1100.0))
    assert values["E"] == pytest.approx(math.log(10.0))
    assert values["A"] == pytest.approx(-math.log(1.0 / 110.0 + 1.0 / 10.0))
    assert MEASURES["weighted"].values(np.array([[[3.0e7]]]))[0] == pytest.approx(3.0e7)
    ours, best = np.array([101.0]), np.array([102.0])
    for name, share in (("D", -1.0), ("A", math.exp(-1.0)), ("E", math.exp(-1.0)), ("weighted", 101.0 / 102.0)):
        assert MEASURES[name].shares(ours, best)[0] == pytest.approx(share), name


def test_every_reference_asks_for_what_it_asks_for_in_the_runtime() -> None:
    rng = np.random.default_rng(1)
    for name, excitation in references(BENCH).items():
        excited = parse_excitation(name, BENCH)
        for k in (0, 17, 250, 499):
            seen = rng.uniform([-5.0, -400.0, k, -6.0], [90.0, 400.0, k, 6.0], (3, 4)).astype(np.float32)
            np.testing.assert_allclose(excitation(seen), [excited.law(a, v, int(s)) for a, v, s, _ in seen.tolist()])


def test_the_interval_is_that_of_the_currents_that_acted_on_each_brake() -> None:
    draws = fresh_draws(WIDE, 3, 3)
    brakes = [draw.brake for draw in draws]
    for plant in ("exact", "stribeck"):
        outcome = play(BENCH, WIDE, PARAMETER_NAMES, constant(3.0), draws, plant)
        (alone,) = MEASURES["T"].of_outcomes(BENCH, plant, PARAMETER_NAMES, brakes, [outcome])
        for currents, brake, found in zip(outcome.currents, brakes, alone, strict=True):
            theta = {name: getattr(brake, name) for name in PARAMETER_NAMES}
            known = api.fisher_information(currents, parameters=theta, plant=plant)
            assert found == pytest.approx(api.interval(known).of_comparison, rel=1e-12)
        (own,) = MEASURES["I"].of_outcomes(BENCH, plant, PARAMETER_NAMES, brakes, [outcome])
        assert (own > alone).all()
    with processes() as pool:
        both = MEASURES["T"].of_outcomes(BENCH, "stribeck", PARAMETER_NAMES, brakes, [outcome, outcome], pool)
    assert [values.tolist() for values in both] == 2 * [alone.tolist()]


def test_an_experiment_that_tells_nothing_is_worth_nothing() -> None:
    draws = fresh_draws(WIDE, 3, 1)
    outcome = play(SHORT, WIDE, PARAMETER_NAMES, constant(0.0), draws)
    (found,) = MEASURES["T"].of_outcomes(SHORT, "exact", PARAMETER_NAMES, [draws[0].brake], [outcome])
    assert found.tolist() == [0.0]


# Known-parameter optimum


def problem(plant: str = "euler", **changes: float) -> Problem:
    brake = BENCH.brake._replace(**changes)
    goal = Criterion("E")
    return make_problem(BENCH, goal, ("f_v",), model=plant, kind="weighted", brake=brake, returns=True)


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """f_v of the brakes that were searched for, without a search: a current that depends on the brake is found."""
    brakes: list[float] = []

    class Found:
        def __init__(self, currents: NDArray[np.float64]) -> None:
            self.best = self
            self.currents = currents

    def search(asked: Problem, **_: Any) -> Found:
        brakes.append(asked.brake.f_v)
        return Found(np.full(asked.horizon, 1e5 * asked.brake.f_v))

    monkeypatch.setattr(optimum, "search", search)
    return brakes


def test_the_known_optimum_is_the_information_of_the_currents_that_were_found(searched: list[float]) -> None:
    brakes = [BENCH.brake._replace(f_v=v) for v in (3e-5, 1e-5, 4e-5)]
    found = optima(BENCH, MEASURES["weighted"], ("f_v",), "euler", brakes, quiet)
    for brake, value in zip(brakes, found, strict=True):
        currents, plant = np.full(500, 1e5 * brake.f_v), BENCH.plant("euler")
        own = fisher(BENCH, brake, currents, kind="weighted", plant=plant, params=("f_v",))
        assert value == pytest.approx(own.matrix[0, 0], rel=1e-9)
    assert searched == [3e-5, 1e-5, 4e-5]


def test_the_known_optimum_is_behind_ideal_instruments_where_the_bench_declares_an_observer_too(
    searched: list[float],
) -> None:
    brakes = [BENCH.brake._replace(f_v=v) for v in (3e-5, 1e-5)]
    found = [optima(bench, MEASURES["D"], ("f_v",), "exact", brakes, quiet) for bench in (SENSOR_BENCH, BENCH)]
    assert found[0].tolist() == found[1].tolist()
    assert len(searched) == 4


def test_speeds_that_are_followed_are_reached_on_another_brake() -> None:
    speeds = np.concatenate([np.linspace(0.0, 60.0, 100), np.linspace(60.0, -60.0, 200), np.linspace(-60.0, -5.0, 200)])
    for plant in ("euler", "exact"):
        asked = problem(plant, k_m=0.015, T_c=0.012)
        design = asked.design(followed(asked, speeds))
        assert np.abs(design.states[21:, 1] - speeds[20:]).max() < 2.5  # T_c changes within a sample


def test_the_optimum_of_a_plant_is_that_of_its_mechanics() -> None:
    on = {name: searchable(plant) for name, plant in BENCH.plants.items()}
    assert {name for name, model in on.items() if model == "euler"} == {"euler"}
    assert {name for name, model in on.items() if model == "exact"} == {"exact", "late", "offset", "jitter", "observer"}


# What is evaluated


def test_table_and_document_say_the_same(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(finished, "--criterion", "weighted", "--json") == 0
    plant = json.loads(capsys.readouterr().out)["plants"]["euler"]
    row = plant["rows"][0]
    assert row["measure"]["value"] == pytest.approx(np.mean(row["values"]))
    assert (row["violated"], len(row["values"]), row["learned"]) == (0, 4, True)
    assert (plant["optima"], row["against_optimum"]) == ([], None)
    assert run(finished, "--criterion", "weighted") == 0
    line = next(x for x in capsys.readouterr().out.splitlines() if x.startswith(str(finished)))
    assert f"{row['measure']['value']:.3e}" in line


def test_the_verdict_and_the_interval_over_policies_are_those_of_the_numbers() -> None:
    """Pushing with +6 A is the best reference in so short an experiment, and one of those that are played."""
    asked = Settings(MEASURES["D"], PARAMETER_NAMES, "pm50", ("exact",), 5, 0, 0, PHYSICAL)
    for current, how in ((6.0, "not significantly different from"), (0.0, "behind"), (-6.0, "behind")):
        subjects = [Subject("it", SHORT, constant(current)), Subject("twin", SHORT, constant(3.0))]
        found = evaluate(SHORT, asked, subjects, quiet)
        plant = found["exact"]
        means = {row.name: row.measure.value for row in plant.rows[2:]}
        best = max(means, key=lambda name: means[name])
        said = " ".join(evaluation_text(asked, found).split())
        assert f" {how} " in said
        scores = [row.measure.value for row in plant.rows[:2]]
        theirs = scipy.stats.ttest_1samp(scores, 0.0).confidence_interval(0.95)
        assert plant.over_policies == pytest.approx((np.mean(scores), theirs.low, theirs.high))
        assert math.isnan(mean_score(np.array(scores[:1])).low)
        record = evaluation_document(asked, found)["plants"]["exact"]
        assert record["best_reference"] == best
        assert record["over_policies"]["value"] == pytest.approx(np.mean(scores))


def test_the_share_of_the_optimum_is_over_the_draws_that_have_one(searched: list[float]) -> None:
    asked = Settings(MEASURES["weighted"], ("f_v",), "viscous", ("late", "exact"), 4, 0, 2, Conditions())
    found = evaluate(BENCH, asked, [open_subject("actor", None)], quiet)
    assert len(searched) == 3  # the one in the middle and two draws, once for both plants
    for plant in found.values():
        row = plant.rows[0]
        assert row.against_optimum is not None
        assert row.against_optimum.value == pytest.approx(np.mean(row.values[:2] / plant.optima))


def test_a_training_for_speeds_is_evaluated_as_the_runtime_plays_its_policy(
    finished_speeds: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(finished_speeds, "--criterion", "D", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    row = said["plants"]["euler"]["rows"][0]
    bench = load_bench(finished_speeds / "bench.toml")
    policy = of_actor(load_policy(finished_speeds / "actor.onnx", bench), bench)
    draws = fresh_draws(bench.range_set("pm50"), 0, 4)
    outcome = play(bench, bench.range_set("pm50"), PARAMETER_NAMES, policy, draws, "euler", PHYSICAL)
    assert row["values"] == MEASURES["D"].values(outcome.matrices).tolist()
    assert said["ranges"] == "pm50"


def test_delays_change_each_experiment_and_are_told(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = []
    for asked, told in (((), [0, 0]), (("--command-delay", "0", "2"), [0, 2])):
        assert run(finished, *asked, "--json") == 0
        said = json.loads(capsys.readouterr().out)
        assert said["conditions"]["command_delay"] == told
        values.append(said["plants"]["euler"]["rows"][0]["values"])
    assert values[0] != values[1]


def test_what_cannot_be_evaluated_is_one_line_and_exit_code_2(
    finished: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert refused(lambda: main(["evaluate", str(finished), "--bench", "any.toml"]), capsys)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("emb_train.evaluate.evaluate", interrupted)
    assert main(["evaluate", "actor"]) == 130
