"""What an evaluation says, against numbers that are computed another way; and what the command does with it."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import scipy.stats
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from emb_bench.compiled import compiled
from emb_bench.excitation.reference import parse_excitation, run_excitation
from emb_bench.information.fisher import fisher
from emb_runtime.config.bench import PARAMETER_NAMES, load_bench, parse_bench, shipped_bench_text
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_train import CHECKPOINT
from emb_train.cli.evaluate import main
from emb_train.envs.batch import Batch
from emb_train.envs.conditions import Conditions
from emb_train.envs.excitations import (
    Constant,
    Network,
    OnnxFile,
    Played,
    StatefulNetwork,
    reference_excitation,
    switch,
)
from emb_train.envs.measure import MEASURES, mean_score
from emb_train.envs.play import Beside, Draw, Together, fresh_draws, play
from emb_train.evaluation import known_optimum
from emb_train.evaluation.actors import open_subject, references
from emb_train.evaluation.evaluation import Settings, evaluate
from emb_train.evaluation.known_optimum import KnownOptimum, OptimumTask, followed, key_of, plant_of
from emb_train.evaluation.report import document, text
from emb_train.structured.stored import stored
from emb_train.training.checkpoint import BEST, load_actor
from emb_train.training.loop import VALIDATION_STREAM
from tests.commands import refused
from tests.train.trainings import HORIZON, short_bench

BENCH = load_bench()
SHORT = parse_bench(shipped_bench_text().replace("horizon     = 500", f"horizon     = {HORIZON}"), "short")
WIDE = BENCH.range_set("pm50")
PHYSICAL = Conditions(information="physical")


def run(*arguments: object) -> int:
    return main([*map(str, arguments), "--optimum-draws", "0", "--draws", "4", "--plant", "euler"])


def test_what_was_played_has_the_information_that_plain_python_computes_from_the_same_currents() -> None:
    draws = fresh_draws(WIDE, seed=5, count=3)
    excited = parse_excitation("square:period=0.2,amplitude=3", BENCH)
    for name in ("euler", "exact"):
        outcome = play(BENCH, WIDE, PARAMETER_NAMES, reference_excitation(excited), draws, name, PHYSICAL)
        plant = BENCH.plant(name)
        for i, draw in enumerate(draws):
            rng = np.random.default_rng(draw.seed)
            rng.uniform(WIDE.low, WIDE.high)
            noise = rng.standard_normal((501, 2)) * [BENCH.noise.angle, BENCH.noise.velocity]
            played = run_excitation(BENCH, excited, plant.mechanics, draw.brake, shielded=True, noise=noise)
            found = fisher(BENCH, draw.brake, played.currents, kind="physical", normalise_by="true", plant=plant)
            np.testing.assert_allclose(outcome.matrices[i], found.matrix, rtol=1e-6)
            assert outcome.home[i] == played.home
            assert outcome.left[i] == (not played.kept)
            assert (outcome.angle[i], outcome.velocity[i]) == pytest.approx(tuple(played.states[-1]), abs=1e-6)


def test_no_evaluation_brake_is_one_of_a_training() -> None:
    seen = {draw.brake for seed in range(20) for draw in fresh_draws(WIDE, seed, 50)}
    assert len(seen) == 1000
    trained_on = set()
    for seed in range(20):
        for iteration in range(5):  # as emb_train.ppo.ppo draws its seeds
            for s in np.random.SeedSequence([seed, iteration]).generate_state(10, np.uint64):
                trained_on.add(tuple(np.random.default_rng(int(s)).uniform(WIDE.low, WIDE.high).tolist()))
        examined = np.random.SeedSequence(seed, spawn_key=(VALIDATION_STREAM,)).generate_state(64, np.uint64)
        trained_on |= {tuple(np.random.default_rng(int(s)).uniform(WIDE.low, WIDE.high).tolist()) for s in examined}
        trained_on |= {tuple(np.random.default_rng(seed + i).uniform(WIDE.low, WIDE.high).tolist()) for i in range(50)}
    assert not trained_on & {tuple(brake) for brake in seen}


def test_a_draw_depends_on_the_seed_and_its_number_alone() -> None:
    few, many = fresh_draws(WIDE, 3, 2), fresh_draws(WIDE, 3, 9)
    assert [d.brake for d in few] == [d.brake for d in many[:2]]
    short = SHORT.range_set("pm50")
    first, second = (play(SHORT, short, ("k_1", "f_v"), Constant(6.0), d) for d in (few, many))
    np.testing.assert_array_equal(first.matrices, second.matrices[:2])


def test_experiments_played_in_parts_are_those_played_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    draws, ranges = fresh_draws(WIDE, 0, 7), SHORT.range_set("pm50")
    whole = play(SHORT, ranges, ("f_v",), Constant(4.0), draws)
    monkeypatch.setattr("emb_train.envs.play.SIDE_BY_SIDE", 3)
    parts = play(SHORT, ranges, ("f_v",), Constant(4.0), draws)
    for field in dataclasses.fields(whole):
        np.testing.assert_array_equal(getattr(whole, field.name), getattr(parts, field.name))


def test_an_experiment_that_leaves_the_limits_keeps_what_it_had_and_is_not_home() -> None:
    strong = Draw(0, BENCH.brake._replace(k_m=3.0 * BENCH.brake.k_m))  # far outside of what the shield covers
    outcome = play(BENCH, WIDE, ("f_v",), Constant(6.0), [strong])
    batch = Batch(BENCH, WIDE, ("f_v",), 1, compiled)
    batch.begin(0, np.random.default_rng(0), strong.brake)
    before = 0.0
    while not batch.violated[0]:
        before = float(batch.m[0, 0])
        batch.advance(np.array([6.0]))
    assert outcome.left[0]
    assert not outcome.home[0]
    assert outcome.matrices[0, 0, 0] == before
    assert (outcome.angle[0], outcome.velocity[0]) == tuple(batch.x[0, :2])


def test_an_actor_that_wants_no_current_at_all_is_refused() -> None:
    with pytest.raises(PolicyRefusedError):
        play(SHORT, SHORT.range_set("pm50"), ("f_v",), Played([1.0] * 7 + [math.nan] * 60), fresh_draws(WIDE, 0, 1))


def test_the_measures_are_those_of_a_matrix_worked_out_by_hand() -> None:
    m = np.array([[[88.0, 30.0], [30.0, 8.0]]])  # with the prior [[100, 30], [30, 20]]: eigenvalues 110 and 10
    values = {name: float(measure.values(m)[0]) for name, measure in MEASURES.items()}
    assert values["D"] == pytest.approx(math.log(1100.0))
    assert values["E"] == pytest.approx(math.log(10.0))
    assert values["A"] == pytest.approx(-math.log(1.0 / 110.0 + 1.0 / 10.0))
    one = MEASURES["weighted"].values(np.array([[[3.0e7]]]))
    assert one[0] == pytest.approx(3.0e7)


def test_the_optimum_is_missed_by_nats_for_d_and_by_a_share_for_the_others() -> None:
    ours, best = np.array([101.0]), np.array([102.0])
    assert MEASURES["D"].shares(ours, best)[0] == -1.0
    for name in ("A", "E"):
        assert MEASURES[name].shares(ours, best)[0] == pytest.approx(math.exp(-1.0))
    assert MEASURES["weighted"].shares(np.array([1.0e7]), np.array([4.0e7]))[0] == 0.25


def test_the_interval_is_students_as_scipy_computes_it() -> None:
    values = np.random.default_rng(0).normal(3.0, 2.0, 9)
    theirs = scipy.stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    ours = mean_score(values)
    assert ours == pytest.approx((values.mean(), theirs.low, theirs.high))
    assert math.isnan(mean_score(values[:1]).low)


def test_every_reference_asks_for_what_it_asks_for_in_the_runtime() -> None:
    rng = np.random.default_rng(1)
    for name, excitation in references(BENCH).items():
        excitation.begin(3)
        excited = parse_excitation(name, BENCH)
        for k in (0, 17, 250, 499):
            seen = rng.uniform([-5.0, -400.0, k, -6.0], [90.0, 400.0, k, 6.0], (3, 4)).astype(np.float32)
            np.testing.assert_allclose(excitation(seen), [excited.law(a, v, int(s)) for a, v, s, _ in seen.tolist()])


def test_a_switch_turns_at_its_step() -> None:
    seen = np.array([[0, 0, k, 0] for k in (0, 4, 5, 9)], np.float32)
    assert switch(6.0, 5, 10)(seen).tolist() == [6.0, 6.0, -6.0, -6.0]


class Counter(nn.Module):
    """An actor with state: its current grows with the samples and with the current that it saw acting."""

    observation_size = 4

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("initial_state", torch.tensor([1.0, 0.0], dtype=torch.float64))

    def forward(self, observation: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        following = torch.stack([state[:, 0] + 1.0, state[:, 1] + observation[:, 3].double()], 1)
        action = (0.5 * following[:, :1] + following[:, 1:]).float()
        return action, following, torch.cat([action, action.abs()], 1)


def counter_file() -> bytes:
    """The same as an ONNX graph, built by hand."""
    helper, kind = onnx.helper, onnx.TensorProto
    nodes = [
        helper.make_node("Slice", ["obs", "three", "four", "axis"], ["applied"]),
        helper.make_node("Cast", ["applied"], ["applied64"], to=kind.DOUBLE),
        helper.make_node("Concat", ["one", "applied64"], ["change"], axis=1),
        helper.make_node("Add", ["state", "change"], ["next_state"]),
        helper.make_node("MatMul", ["next_state", "weights"], ["action64"]),
        helper.make_node("Cast", ["action64"], ["action"], to=kind.FLOAT),
        helper.make_node("Abs", ["action"], ["size"]),
        helper.make_node("Concat", ["action", "size"], ["estimate"], axis=1),
    ]
    constants: list[tuple[str, NDArray[Any]]] = [
        ("three", np.array([3])),
        ("four", np.array([4])),
        ("axis", np.array([1])),
        ("one", np.array([[1.0]])),
        ("weights", np.array([[0.5], [1.0]])),
    ]
    graph = helper.make_graph(
        nodes,
        "counter",
        [
            helper.make_tensor_value_info("obs", kind.FLOAT, [1, 4]),
            helper.make_tensor_value_info("state", kind.DOUBLE, [1, 2]),
        ],
        [
            helper.make_tensor_value_info("action", kind.FLOAT, [1, 1]),
            helper.make_tensor_value_info("next_state", kind.DOUBLE, [1, 2]),
            helper.make_tensor_value_info("estimate", kind.FLOAT, [1, 2]),
        ],
        [onnx.numpy_helper.from_array(value, name) for name, value in constants],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9)
    return bytes(model.SerializeToString())


def test_actors_with_state_remember_each_experiment_by_itself_and_begin_anew() -> None:
    network, file = StatefulNetwork(Counter()), OnnxFile(counter_file(), (1.0, 0.0))
    seen = np.zeros((2, 4), np.float32)
    seen[:, 3] = [1.0, -2.0]
    for _ in range(2):
        for excitation in (network, file):
            excitation.begin(2)
            assert excitation(seen).tolist() == [0.5 * 2 + 1.0, 0.5 * 2 - 2.0]
            assert excitation(seen).tolist() == [0.5 * 3 + 2.0, 0.5 * 3 - 4.0]


def test_a_file_whose_state_is_not_the_contracts_is_refused() -> None:
    with pytest.raises(PolicyRefusedError):
        OnnxFile(counter_file())
    with pytest.raises(PolicyRefusedError):
        OnnxFile(b"no graph")


def test_a_refused_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "empty.onnx"
    path.touch()
    with pytest.raises(PolicyRefusedError):
        open_subject(str(path), None)


def test_a_network_of_another_shape_is_refused() -> None:
    with pytest.raises(UsageError):
        Network(nn.Linear(3, 2))(np.zeros((5, 4), np.float32))


def test_two_forms_of_an_actor_are_compared_at_what_the_played_one_sees() -> None:
    both = Beside(Constant(2.0), switch(2.0, 30, HORIZON))
    outcome = play(SHORT, SHORT.range_set("pm50"), ("f_v",), both, fresh_draws(WIDE, 0, 3))
    alone = play(SHORT, SHORT.range_set("pm50"), ("f_v",), Constant(2.0), fresh_draws(WIDE, 0, 3))
    assert both.apart == 4.0
    np.testing.assert_array_equal(outcome.matrices, alone.matrices)
    broken = Beside(Constant(2.0), Constant(math.nan))
    broken.begin(1)
    broken(np.zeros((1, 4), np.float32))
    assert math.isnan(broken.apart)


def test_several_excitations_share_the_experiments() -> None:
    together = Together([Constant(1.0), Constant(2.0)])
    together.begin(4)
    assert together(np.zeros((4, 4), np.float32)).tolist() == [1.0, 1.0, 2.0, 2.0]


# --- Known-parameter optimum ----------------------------------------------------------------------------------------


def task(**changes: Any) -> OptimumTask:
    brake = BENCH.brake._replace(f_v=3e-5)
    return OptimumTask(BENCH.text, "euler", "weighted", ("f_v",), brake)._replace(**changes)


def pretended(asked: OptimumTask) -> NDArray[np.float64]:
    """In place of a search: a current that depends on the brake."""
    return np.full(500, 1e5 * asked.brake.f_v)


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> list[OptimumTask]:
    """What was looked for, in this process and without looking."""
    tasks: list[OptimumTask] = []

    def at_once(work: Callable[[OptimumTask], Any], pieces: list[OptimumTask], jobs: int) -> Any:
        for number, piece in enumerate(pieces):
            tasks.append(piece)
            yield number, pretended(piece)

    monkeypatch.setattr(known_optimum, "shared_out", at_once)
    return tasks


def test_the_known_optimum_is_the_information_of_the_kept_currents_and_is_looked_for_once(
    searched: list[OptimumTask], tmp_path: Path
) -> None:
    path, measure = tmp_path / "new" / "optima.jsonl", MEASURES["weighted"]
    known = KnownOptimum(BENCH, measure, ("f_v",), path)
    brakes = [BENCH.brake._replace(f_v=v) for v in (1e-5, 4e-5)]
    told: list[str] = []
    optima = known.optima("euler", BENCH.brake, brakes, 1, told.append)
    for brake, optimum in zip(brakes, optima, strict=True):
        currents = np.full(500, 1e5 * brake.f_v)
        own = fisher(
            BENCH, brake, currents, kind="weighted", normalise_by="true", plant=BENCH.plant("euler"), params=("f_v",)
        )
        assert optimum == pytest.approx(own.matrix[0, 0], rel=1e-9)
    assert [t.brake.f_v for t in searched] == [BENCH.brake.f_v, 1e-5, 4e-5]
    assert told[-1] == "optimum on euler: brake 2 of 2"
    with path.open("a") as file:
        file.write('{"key": "cut')  # as a kill leaves it
    more = [*brakes, BENCH.brake._replace(f_v=2e-5)]
    again = known.optima("euler", BENCH.brake, more, 1, told.append)
    np.testing.assert_array_equal(again[:2], optima)
    assert [t.brake.f_v for t in searched[3:]] == [2e-5]
    known.optima("euler", BENCH.brake, more, 1, told.append)
    assert len(searched) == 4


def test_an_optimum_is_kept_for_what_it_depends_on_and_nothing_else() -> None:
    other = BENCH.text.replace("[noise]", "[noise] # the same")
    assert key_of(task(bench=other)) == key_of(task())
    different = [
        task(plant="exact"),
        task(measure="D"),
        task(parameters=("k_1", "f_v")),
        task(brake=BENCH.brake),
        task(speeds=(1.0,) * 500),
        task(bench=BENCH.text.replace("angle    = 1.0e-3", "angle    = 2.0e-3")),
    ]
    assert len({key_of(t) for t in [task(), *different]}) == 7


def test_speeds_that_are_followed_are_reached_on_another_brake() -> None:
    speeds = np.concatenate([np.linspace(0.0, 60.0, 100), np.linspace(60.0, -60.0, 200), np.linspace(-60.0, -5.0, 200)])
    for plant in ("euler", "exact"):
        problem = task(plant=plant, brake=BENCH.brake._replace(k_m=0.015, T_c=0.012)).problem()
        design = problem.design(followed(problem, speeds.tolist()))
        assert np.abs(design.states[21:, 1] - speeds[20:]).max() < 2.5  # T_c changes within a sample


def test_the_optimum_of_a_plant_is_that_of_its_mechanics() -> None:
    on = {name: plant_of(plant) for name, plant in BENCH.plants.items()}
    assert {name for name, optimum in on.items() if optimum == "euler"} == {"euler"}
    assert {name for name, optimum in on.items() if optimum == "exact"} == {
        "exact",
        "late",
        "offset",
        "jitter",
        "observer",
    }


# --- What is evaluated ------------------------------------------------------------------------------------------------


def test_the_shipped_actor_is_on_its_own_ranges_inside_the_limits_at_home_and_beats_pushing() -> None:
    subject = open_subject("actor", None)
    assert (subject.ranges, subject.parameters) == ("pm50", PARAMETER_NAMES)
    asked = Settings(MEASURES["D"], PARAMETER_NAMES, "pm50", ("exact",), 12, 0, 0)
    found = evaluate(BENCH, asked, [subject], None, 1, lambda line: None)
    (plant,) = found.plants
    rows = {row.name: row for row in plant.rows}
    actor = rows["actor"]
    assert not actor.outcome.left.any()
    assert actor.outcome.home.all()
    assert actor.worst_angle < 0.5
    assert plant.ahead(rows["step:amplitude=6"]).low > 0.0
    policy = load_policy(shipped_actor_path(), BENCH)
    file = OnnxFile(policy.data, policy.contract.initial_state)
    alone = play(BENCH, BENCH.range_set("pm50"), PARAMETER_NAMES, file, found.draws, "exact", PHYSICAL)
    np.testing.assert_allclose(actor.values, MEASURES["D"].values(alone.matrices), rtol=1e-9)


@pytest.mark.slow
def test_network_and_file_are_both_played_and_must_agree(finished: Path, tmp_path: Path) -> None:
    from emb_export.export import main as export

    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("bench.toml", "config.json", "checkpoint.safetensors"):
        (folder / name).write_bytes((finished / name).read_bytes())
    assert export([str(folder)]) == 0
    out = tmp_path / "out"
    assert run(folder, "--out", out) == 0
    document = json.loads((out / "evaluation.json").read_text())
    forms = [row["form"] for row in document["plants"]["euler"]["rows"]]
    assert forms[:3] == ["network", "file", "reference"]
    assert document["agree"] is True
    assert document["plants"]["euler"]["largest_difference"] < 1e-6
    assert "they agree" in (out / "evaluation.txt").read_text()
    # The file of another training stands beside the network: that is found out.
    short = tmp_path / "other.toml"
    short.write_text((folder / "bench.toml").read_text())
    assert export(["step:amplitude=2", "--bench", str(short), "--out", str(folder / "actor.onnx")]) == 0
    assert run(folder) == 1


def test_table_and_document_say_the_same(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(finished, "--criterion", "weighted", "--json") == 0
    document_ = json.loads(capsys.readouterr().out)
    row = document_["plants"]["euler"]["rows"][0]
    assert row["measure"]["value"] == pytest.approx(np.mean(row["values"]))
    assert (row["left"], row["runs"], len(document_["brakes"])) == (0, 4, 4)
    assert document_["plants"]["euler"]["optima"] == []
    assert row["against_optimum"] is None
    assert run(finished, "--criterion", "weighted") == 0
    line = next(x for x in capsys.readouterr().out.splitlines() if x.startswith(str(finished)))
    assert f"{row['measure']['value']:.3e}" in line
    assert f"{row['worst_end_speed']:.2f}" in line


@pytest.mark.parametrize(
    ("current", "how"),
    [(6.0, "not significantly different from"), (0.0, "behind"), (-6.0, "behind")],
    ids=["best", "rest", "worse"],
)
def test_the_verdict_says_of_the_first_actor_what_the_numbers_say(finished: Path, current: float, how: str) -> None:
    """Pushing with +6 A is the best reference in so short an experiment, and one of those that are played."""
    subject = dataclasses.replace(open_subject(str(finished), None), network=lambda: Constant(current), name="it")
    asked = Settings(MEASURES["D"], PARAMETER_NAMES, "pm50", ("exact",), 5, 0, 0)
    found = evaluate(subject.bench, asked, [subject], None, 1, lambda line: None)
    (plant,) = found.plants
    means = {row.name: row.score.value for row in plant.rows[1:]}
    best = max(means, key=lambda name: means[name])
    said = " ".join(text(found).split())
    assert f"it is {how} the best reference on these draws, {best}, by" in said
    assert "every run kept the limits and ended at the origin" in said
    assert document(found)["plants"]["exact"]["best_reference"] == best
    assert "against optimum" not in said


def test_several_actors_give_an_interval_over_them(finished: Path, tmp_path: Path) -> None:
    subject = open_subject(str(finished), None)
    twin = dataclasses.replace(subject, name="twin", network=lambda: Constant(3.0))
    asked = Settings(MEASURES["D"], ("f_v",), "viscous", ("euler",), 3, 0, 0)
    found = evaluate(subject.bench, asked, [subject, twin], None, 1, lambda line: None)
    scores = [row.score.value for row in found.plants[0].rows[:2]]
    theirs = scipy.stats.ttest_1samp(scores, 0.0).confidence_interval(0.95)
    assert found.over_seeds(found.plants[0]) == pytest.approx((np.mean(scores), theirs.low, theirs.high))
    assert "mean of the 2 actors" in text(found)
    assert document(found)["plants"]["euler"]["over_actors"]["value"] == pytest.approx(np.mean(scores))


def test_the_share_of_the_optimum_is_over_the_draws_that_have_one(searched: list[OptimumTask], tmp_path: Path) -> None:
    asked = Settings(MEASURES["weighted"], ("f_v",), "viscous", ("late", "exact"), 4, 0, 2)
    known = KnownOptimum(BENCH, asked.measure, asked.parameters, tmp_path / "optima.jsonl")
    found = evaluate(BENCH, asked, [open_subject("actor", None)], known, 1, lambda line: None)
    assert len(searched) == 3  # the one in the middle and two draws, once for both plants
    for plant in found.plants:
        assert plant.optimum_plant == "exact"
        row = plant.rows[0]
        share = plant.share(row, asked.measure)
        assert share is not None
        assert share.value == pytest.approx(np.mean(row.values[:2] / plant.optima))
    assert "on exact, 2 draws" in text(found)


@pytest.mark.slow
def test_a_structured_actor_and_its_file_are_played_with_their_state_and_agree(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from emb_export.export import main as export

    short = short_bench(tmp_path)
    kept = dataclasses.replace(stored("four-d-exact-blind"), command="none")
    (tmp_path / "own.json").write_text(kept.to_json())
    assert export([str(tmp_path / "own.json"), "--bench", str(short), "--out", str(tmp_path / "own.onnx")]) == 0
    capsys.readouterr()
    assert run(tmp_path / "own.json", "--bench", short, "--shield", "pm50", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["ranges"], said["shield"], said["parameters"]) == ("pm50", "pm50", list(PARAMETER_NAMES))
    assert said["agree"] is True
    network, file = said["plants"]["euler"]["rows"][:2]
    assert network["values"] == pytest.approx(file["values"], abs=1e-4)


def test_of_a_training_the_best_checkpoint_is_played_and_the_last_one_where_that_is_asked_for_or_all_there_is(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("bench.toml", "config.json", CHECKPOINT, BEST):
        (folder / name).write_bytes((finished / name).read_bytes())
    last, best = (load_actor(folder, name)[3].iteration for name in (CHECKPOINT, BEST))
    assert open_subject(str(folder), None).origin == f"best.safetensors, iteration {best} of 3"
    assert open_subject(str(folder), None, last=True).origin == f"checkpoint.safetensors, iteration {last} of 3"
    assert run(folder, "--last") == 0
    assert f"of {folder} is played: checkpoint.safetensors, iteration 3 of 3\n" in capsys.readouterr().out
    assert run(folder, "--last", "--json") == 0
    assert json.loads(capsys.readouterr().out)["origins"] == ["checkpoint.safetensors, iteration 3 of 3"]
    (folder / BEST).unlink()
    assert open_subject(str(folder), None).origin == "checkpoint.safetensors, iteration 3 of 3"


@pytest.mark.parametrize("name", [BEST, CHECKPOINT])
def test_a_checkpoint_that_is_named_is_played_alone(name: str, finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    for kept in ("bench.toml", "config.json", name):
        (folder / kept).write_bytes((finished / kept).read_bytes())
    (folder / "actor.onnx").write_bytes(b"of another iteration")
    subject = open_subject(str(folder / name), None)
    assert subject.network is not None
    assert subject.file is None


def test_an_actor_is_evaluated_behind_the_shield_that_it_learned_behind_unless_another_one_is_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert open_subject("actor", None).shield == ""
    assert open_subject("four-d-exact-blind", None).shield == "", "the bench's own"
    arguments = ("viscous-exact-quadratic", "--criterion", "weighted", "--json")
    assert run(*arguments) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["ranges"], said["shield"]) == ("viscous", "viscous")
    assert [row["left"] for row in said["plants"]["euler"]["rows"]] == [0] * len(said["plants"]["euler"]["rows"])
    assert run(*arguments, "--shield", "pm50") == 2  # which does not cover the brakes
    assert run("actor", "viscous-exact-quadratic", "--ranges", "viscous", "--parameters", "f_v") == 2


def test_what_is_randomised_changes_each_experiment_and_is_told(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = ("--randomise", "command_delay=0,2", "--randomise", "frame_loss=0,0.1", "--json")
    documents = []
    for options in (("--json",), own):
        assert run(finished, *options) == 0
        documents.append(json.loads(capsys.readouterr().out))
    plain, random = documents
    assert (plain["randomised"], random["randomised"]) == ({}, {"command_delay": [0, 2], "frame_loss": [0.0, 0.1]})
    assert plain["brakes"] == random["brakes"]
    values = [d["plants"]["euler"]["rows"][0]["values"] for d in documents]
    assert values[0] != values[1]
    assert run(finished, *own[:-1]) == 0
    table = " ".join(capsys.readouterr().out.split())
    assert "its own command_delay from 0 to 2, frame_loss from 0 to 0.1; the shield is widened" in table


def test_where_no_optima_can_be_kept_nothing_is_looked_for_and_nothing_is_made(
    tmp_path: Path, searched: list[OptimumTask], capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "notes.txt"
    other.write_text("no optima")
    out = tmp_path / "out"
    for path, said in (
        (tmp_path / "none" / "x", f"there is no directory {tmp_path / 'none'}"),
        (tmp_path, "expected a file that can be written to"),
        (other, "holds no optima, but something else"),
    ):
        assert said in refused(lambda: main(["actor", "--optimum-file", str(path), "--out", str(out)]), capsys)  # noqa: B023  # called at once
    assert not searched
    assert list(tmp_path.iterdir()) == [other]


def test_what_cannot_be_evaluated_is_one_line_and_exit_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (
        ["actor", "--shield", "viscous", "--ranges", "pm50"],
        ["nothing"],
        ["gone.onnx"],
        ["actor", "actor"],
        ["actor", "--last"],
        ["actor", "--parameters", "J"],
        ["actor", "--ranges", "none"],
        ["actor", "--plant", "none"],
        ["actor", "--plant", "euler,euler"],
        ["actor", "--draws", "1"],
        ["actor", "--jobs", "0"],
        ["actor", "--seed", "1000000"],
        ["actor", "--randomise", "wind=0,1"],
        ["actor", "--randomise", "current_lag=0,0.002"],  # the thesis's brake knows none
    ):
        assert refused(lambda: main(arguments), capsys), arguments  # noqa: B023  # called at once


def test_ctrl_c_says_what_is_kept(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("emb_train.evaluation.evaluation.evaluate", interrupted)
    assert main(["actor"]) == 130
    assert "the optima that were found are kept" in capsys.readouterr().err
