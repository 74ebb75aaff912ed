"""Tuning, what is kept of it, and the ladder of excitations that need no learning."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emb_bench.information.fisher import fisher
from emb_bench.information.symmetric import Floats, packed_index
from emb_export.export import export_structured
from emb_export.export import parser as export_parser
from emb_runtime.config.bench import load_bench
from emb_runtime.errors import UsageError
from emb_runtime.safety.shield_design import make_law
from emb_train.cli import tune
from emb_train.cli.evaluate import parser as evaluate_parser
from emb_train.envs.excitations import Constant, StatefulNetwork
from emb_train.envs.play import play
from emb_train.evaluation import known_optimum
from emb_train.evaluation.actors import open_subject
from emb_train.names import reference_names
from emb_train.structured import evolution, tuning
from emb_train.structured.actor import actor_of
from emb_train.structured.estimator import COVARIANCE, PARAMETERS, STEP, UNKNOWNS
from emb_train.structured.evolution import evolve
from emb_train.structured.law import QUADRATIC_TERMS, TERMS, speed_loop
from emb_train.structured.stored import FORMS, read_text, stored
from emb_train.structured.task import TASKS, Task
from emb_train.structured.trial import ANY_PRECISION
from emb_train.structured.tuning import TUNING_SEED, climb, means, random_tables
from studies.ladder import cli
from studies.ladder.ladder import (
    FOLDER,
    Rung,
    blind_of,
    constant,
    follow,
    follow_all,
    ladder,
    oracle_laws,
    over_seeds,
    reference,
    references_of,
    rung,
    table,
)

BENCH = load_bench()
FOUR, VISCOUS, WIDE = (dataclasses.replace(TASKS[name], plant="euler") for name in ("four-d", "viscous", "four-d-wide"))


def start_of(numbers: list[float]) -> Floats:
    result = np.zeros((len(numbers), TERMS))
    result[:, 0] = numbers
    return result


def following(task: Task) -> list[str]:
    """References that were tuned behind a shield that follows what is learnt, one such shield after the other."""
    behind = [dataclasses.replace(task, shield=shield) for shield in ("belief", "bounded", "gaussian")]
    return [name for one in behind for name in references_of(one)]


def test_every_stored_reference_is_read_back_as_it_was_written_and_fits_its_name() -> None:
    ours = [path.stem for path in FOLDER.glob("*.json")]
    assert not set(ours) & set(reference_names())
    assert {f"{name}-speed" for name, task in TASKS.items() if task.precision == ANY_PRECISION} <= {
        *ours,
        *reference_names(),
    }
    for name in (*ours, *reference_names()):
        kept = reference(name)
        assert read_text(kept.to_json(), name) == kept
        assert name.startswith(f"{kept.task}-")
        assert ("belief" in name) == (kept.shield == "belief")
        assert kept.form in FORMS
        assert kept.form in name or (kept.form == "speed" and name.endswith("-blind-control"))
        if kept.form in ("current", "speed"):
            assert not kept.array()[:, 1:].any()
        assert kept.command.endswith(f"/{name}.json") or (name, kept.command[:8]) == ("four-d-quick-speed", "by hand:")


@pytest.mark.parametrize("name", ["four-d-speed", "four-d-affine"])
@pytest.mark.slow
def test_a_stored_reference_keeps_the_limits_and_comes_home_and_beats_the_best_blind_current(name: str) -> None:
    draws = FOUR.draws(BENCH, 1, 40)
    found = follow(name, FOUR, BENCH, draws)
    assert (found.violations, found.home) == (0, 40)
    assert found.angle <= BENCH.shield.home_angle
    assert found.velocity <= BENCH.shield.home_velocity
    assert found.beyond(follow("four-d-current", FOUR, BENCH, draws)).low > 0.0


def test_rungs_are_played_by_the_environment_of_the_evaluation() -> None:
    draws = FOUR.draws(BENCH, 4, 8)
    best = constant(FOUR, BENCH, draws)
    limit = float(best.name.split()[1])
    ranges = BENCH.range_set(FOUR.ranges)
    again = play(BENCH, ranges, FOUR.parameters, Constant(limit), draws, "euler", FOUR.conditions)
    assert rung("again", FOUR, again).values.tolist() == best.values.tolist()


def test_a_grid_is_played_as_often_as_it_takes_each_time_with_other_noise() -> None:
    once, often = VISCOUS.draws(BENCH, 5), VISCOUS.draws(BENCH, 5, 81)
    assert len(once) == 40
    assert [draw.brake for draw in often] == 3 * [draw.brake for draw in once]
    assert [draw.seed for draw in often] == list(range(5, 125))
    assert VISCOUS.draws(BENCH, 5, 40) == once


def test_a_ladder_names_every_rung_and_compares_with_the_blind_speeds_on_the_same_brakes() -> None:
    draws = VISCOUS.draws(BENCH, 1)
    rungs = ladder(VISCOUS, BENCH, draws, designed=False)
    assert [r.name for r in rungs[1:]] == references_of(VISCOUS) + following(VISCOUS)
    assert len(rungs[0].values) == 40
    assert all(r.violations == 0 and r.home == 40 for r in rungs)
    lines = table(VISCOUS, BENCH, rungs).splitlines()
    assert lines[0].endswith("40 brakes, shield 'viscous', euler")
    assert len(lines) == 2 + len(rungs) + 1
    words = [line.split() for line in lines[2:-1]]
    assert all((row[-8], row[-6]) == ("-", "-") for row in words)  # a grid of brakes is no sample: no interval
    adapting = [r.mean.value for r in rungs if r.name.startswith("viscous-affine")]
    assert over_seeds(VISCOUS, rungs) == adapting
    assert f"{len(adapting)} seeds of the search: {np.mean(adapting):.6g}" in lines[-1]
    assert "viscous-speed" in lines[2 + [r.name for r in rungs].index("viscous-speed")]


def test_a_shield_that_knows_the_brake_holds_it_and_tells_more() -> None:
    draws = FOUR.draws(BENCH, 6, 12)
    laws = oracle_laws(BENCH, [draw.brake for draw in draws])
    assert laws[0].motor_low == pytest.approx(0.998 * draws[0].brake.k_m / BENCH.brake.J)
    assert laws[0].cruise > make_law(BENCH).cruise
    kept = stored("four-d-speed")
    worst, known = (rung("", FOUR, follow_all(kept, FOUR, BENCH, draws, given)) for given in (None, laws))
    assert known.violations == 0
    assert known.mean.value > worst.mean.value


def test_the_rungs_of_a_believing_shield_follow_and_say_how_often_it_was_mistaken() -> None:
    draws = FOUR.draws(BENCH, 1, 6)
    rungs = ladder(FOUR, BENCH, draws, designed=False)
    behind = following(FOUR)
    assert behind
    assert [r.name for r in rungs[1:]] == references_of(FOUR) + behind
    assert [r.mistaken for r in rungs] == [None] * (1 + len(references_of(FOUR))) + [0] * len(behind)
    last = table(FOUR, BENCH, rungs).splitlines()[1 + len(rungs)].split()
    assert (last[0], last[-1]) == (behind[-1], "0")
    assert float(last[2]) > 0.0  # these brakes are drawn: their mean has an interval


EXACT_LATE = dataclasses.replace(FOUR, plant="exact", command_delay=(0, 2))


def rungs_of(task: Task) -> list[Rung]:
    """A rung for each reference of a task, the first with the criterion 0 on three brakes, the next with 1."""
    names = references_of(task)
    return [Rung(name, np.full(3, float(i)), 0, 3, 0.0, 0.0, None) for i, name in enumerate(names)]


def test_what_was_tuned_for_another_plant_or_delay_is_no_seed_of_the_search() -> None:
    rungs = rungs_of(EXACT_LATE)
    assert {"four-d-affine", "four-d-exact-affine"} <= {r.name for r in rungs}
    assert over_seeds(EXACT_LATE, rungs) == [r.mean.value for r in rungs if r.name == "four-d-exact-affine"]
    assert over_seeds(dataclasses.replace(FOUR, plant="exact"), rungs) == []
    assert over_seeds(dataclasses.replace(FOUR, command_delay=(0, 2)), rungs) == []
    assert len(over_seeds(FOUR, rungs_of(FOUR))) == 5


def test_differences_are_to_the_blind_speeds_that_were_tuned_for_the_same_plant_and_delay() -> None:
    assert [blind_of(task) for task in (FOUR, EXACT_LATE)] == ["four-d-speed", "four-d-exact-speed"]
    assert blind_of(dataclasses.replace(FOUR, shield="belief")) == "four-d-belief-speed"
    assert blind_of(dataclasses.replace(FOUR, plant="exact", command_delay=(0, 1))) == ""
    rungs = rungs_of(EXACT_LATE)
    own, other = (next(r for r in rungs if r.name == name) for name in ("four-d-exact-speed", "four-d-affine"))
    rows = {line.split()[0]: line.split() for line in table(EXACT_LATE, BENCH, rungs).splitlines()[2:]}
    assert rows["four-d-exact-speed"][3] == "-"
    assert float(rows["four-d-affine"][3]) == other.mean.value - own.mean.value


def test_chosen_references_are_played_behind_a_chosen_shield_and_compared_with_the_first(
    capsys: pytest.CaptureFixture[str],
) -> None:
    given = ["--plant", "exact", "--draws", "3", "--shield", "gaussian", "--references"]
    assert cli.main(["four-d", *given, "four-d-exact-quadratic", "four-d-exact-affine"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "shield: gaussian"
    first, second = ({"name": line.split()[0], "beyond": line.split()[3]} for line in said[3:5])
    assert (first["name"], first["beyond"], second["name"]) == ("four-d-exact-quadratic", "-", "four-d-exact-affine")
    assert float(second["beyond"]) < 0.0
    assert cli.main(["four-time", *given, "four-time-exact-quadratic"]) == 0
    assert "four-time-exact-quadratic: 95 % of the times 0." in capsys.readouterr().out


def test_references_are_compared_with_the_optimum_of_each_known_brake(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    pushed = np.full(500, 3.0)  # stands for what a search finds
    monkeypatch.setattr(known_optimum, "shared_out", lambda work, tasks, jobs: ((i, pushed) for i in range(len(tasks))))
    task = dataclasses.replace(TASKS["viscous-stiffness"], plant="euler")
    draws = task.draws(BENCH, cli.EVALUATION_SEED, 3)
    given = ["--draws", "3", "--references", "viscous-stiffness-affine", "--optimum-draws", "2"]
    assert cli.main([task.name, *given]) == 0
    *_, count, line = capsys.readouterr().out.splitlines()
    values = follow("viscous-stiffness-affine", task, BENCH, draws).values
    plant, params = BENCH.plant("euler"), task.parameters
    own = [
        fisher(BENCH, d.brake, pushed, kind="weighted", normalise_by="true", plant=plant, params=params).matrix
        for d in draws[:2]
    ]
    assert count == "beside the optimum of each of 2 brakes, as if it were known:"
    assert line.split()[:2] == [
        "viscous-stiffness-affine:",
        f"{np.mean(values[:2] / np.linalg.eigvalsh(own)[:, 0]):.4f}",
    ]
    assert line.endswith(" of it")


def test_a_wide_set_tells_more_without_a_first_move(capsys: pytest.CaptureFixture[str]) -> None:
    def mean(*more: str) -> float:
        assert cli.main(["four-d-wide", "--draws", "8", *more, "--references", "four-d-wide-speed"]) == 0
        return float(capsys.readouterr().out.splitlines()[3].split()[1])

    assert mean("--no-first-move") > mean() + 1.0


def test_the_headline_says_up_to_which_angle_a_wide_set_is_covered() -> None:
    headline = table(WIDE, BENCH, rungs_of(WIDE)).splitlines()[0]
    assert "3 brakes, shield 'pm80' up to 35.8 of 100 rad, euler" in headline


def test_what_no_bench_covers_is_refused_where_a_bench_is_to_play_it_and_is_not_listed() -> None:
    for name in reference_names():
        assert stored(name).on_a_bench(name) == stored(name).asked()
    path = str(FOLDER / "four-d-wide-speed.json")
    said = "speed.json: it is for brakes within 80%, which no bench's shield covers; only python -m studies.ladder"
    with pytest.raises(UsageError, match=said):
        open_subject(path, None)
    with pytest.raises(UsageError, match=said):
        export_structured(path, BENCH)
    for command in (evaluate_parser(), export_parser()):
        assert "four-d-speed" in command.format_help()
        assert "four-d-wide" not in command.format_help()


def test_tuning_improves_what_it_begins_with_and_is_the_same_for_the_same_seed() -> None:
    trials = FOUR.trials(BENCH, FOUR.draws(BENCH, TUNING_SEED, 4))
    begin = start_of([0.6, -0.6, 0.0, 0.3, 0.6])
    first, second = (climb(FOUR, trials, speed_loop(BENCH), begin, generations=3, seed=5) for _ in range(2))
    before = float(means(FOUR, trials, speed_loop(BENCH), begin[None])[0])
    assert first.score > before
    assert first.table.tolist() == second.table.tolist()
    assert not first.table[:, 1:].any()


def test_only_what_is_uncertain_is_leant_on_and_the_same_seed_learns_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    trials = VISCOUS.trials(BENCH, VISCOUS.draws(BENCH, TUNING_SEED))
    begin = start_of([1.0, -1.0, 0.4])
    monkeypatch.setattr(evolution, "JUDGED", 16)
    seen: list[evolution.Progress] = []
    found = evolve(VISCOUS, BENCH, speed_loop(BENCH), begin, steps=8, seed=0, batch=16, show=seen.append)
    assert found.table[:, 4].all()
    assert not found.table[:, 1:4].any()  # k_m, k_1, T_c are known
    assert found.score > float(means(VISCOUS, trials, speed_loop(BENCH), begin[None])[0])
    assert [progress.steps for progress in seen] == list(range(1, 9))
    assert not any(progress.left for progress in seen)
    again = evolve(VISCOUS, BENCH, speed_loop(BENCH), begin, steps=8, seed=0, batch=16)
    assert again.table.tolist() == found.table.tolist()


def test_where_a_precision_is_asked_for_the_time_until_it_counts_and_the_way_home_follows() -> None:
    kept = stored("four-time-exact-quadratic")
    task = kept.asked()
    trials = task.trials(BENCH, task.draws(BENCH, 5, 12))
    (outcome,) = trials.play(kept.loop(BENCH), kept.array()[None])
    assert task.score(outcome).tolist() == (-outcome.known).tolist()
    assert outcome.home.all()
    assert (outcome.known < 0.3).all()
    where = [COVARIANCE + packed_index(UNKNOWNS, i, i) for i in range(2, UNKNOWNS)]
    shares = np.sqrt(outcome.estimates[:, where]) / outcome.estimates[:, PARAMETERS:COVARIANCE]
    assert (shares.max(axis=1) <= task.precision[0]).all()
    assert (shares.max(axis=1) > 0.7 * task.precision[0]).all()  # at that moment, not at the end
    steps = outcome.estimates[:, STEP] * BENCH.timing.sample_time
    assert (steps - outcome.known < BENCH.timing.sample_time).all()  # between samples, and the last one is after it
    assert (steps >= outcome.known).all()


def test_a_precision_that_is_never_reached_counts_as_longer_than_the_experiment() -> None:
    task = dataclasses.replace(TASKS["four-time"], precision=(1e-9,) * 4)
    trials = task.trials(BENCH, task.draws(BENCH, 5, 2))
    (outcome,) = trials.play(speed_loop(BENCH), start_of([1.0, -1.0, 0.4])[None])
    assert (outcome.known > BENCH.timing.horizon * BENCH.timing.sample_time).all()


@pytest.mark.parametrize(("form", "terms"), [("affine", TERMS), ("quadratic", QUADRATIC_TERMS)])
def test_the_command_learns_a_reference_that_adapts_and_keeps_it(
    form: str, terms: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(evolution, "JUDGED", 16)
    out = tmp_path / "learnt.json"
    assert tune.main(["four-time", "--form", form, "--steps", "2", "--out", str(out)]) == 0
    kept = stored(str(out))
    assert kept.array().shape == (5, terms)
    assert (kept.form, kept.draws) == (form, 2 * evolution.BATCH)
    assert "2/2 steps" in capsys.readouterr().err
    further = tmp_path / "further.json"
    given = ["four-time", "--form", form, "--steps", "1", "--start", str(out), "--out", str(further)]
    assert tune.main(given) == 0
    assert stored(str(further)).start == "learnt.json"
    other = "affine" if form == "quadratic" else "quadratic"
    if form == "quadratic" or kept.array()[:, 1:].any():
        assert tune.main([*given[:2], other, *given[3:]]) != 0
        assert "--start: expected a blind or" in capsys.readouterr().err


def test_random_references_have_ordered_switches_and_all_kinds_of_levels() -> None:
    tables, kinds = random_tables(np.random.default_rng(0), 4, 200)
    assert (np.diff(tables[:, 4:, 0], axis=1) >= 0.0).all()
    assert set(kinds.ravel().tolist()) == {0, 1, 2, 3}
    assert (tables[:, :4, 0][kinds == 0] == 1.0).all()
    assert not tables[:, :, 1:].any()


def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search that takes a moment."""
    monkeypatch.setattr(tuning, "DRAWN", 20)
    monkeypatch.setattr(tuning, "STARTS", 2)
    monkeypatch.setattr(tuning, "FIRST_GENERATIONS", 1)


def test_the_command_searches_from_many_places_and_keeps_what_it_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    quickly(monkeypatch)
    out = tmp_path / "found.json"
    given = ["four-d", "--form", "speed", "--levels", "3", "--generations", "1", "--draws", "3", "--out", str(out)]
    assert tune.main(given) == 0
    kept = stored(str(out))
    assert kept.array().shape == (5, TERMS)
    assert kept.command.endswith(" ".join(given))
    assert f"{kept.score:.6g}" in capsys.readouterr().out
    believing = tmp_path / "believing.json"
    assert tune.main([*given[:1], "--shield", "belief", *given[1:-1], str(believing)]) == 0
    assert stored(str(believing)).asked().shield == "belief"


def test_what_a_search_began_with_is_named_as_it_was_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, out = tmp_path / "begun.json", tmp_path / "found.json"
    text = stored("four-d-speed").to_json()
    begun.write_text(text, encoding="utf-8")

    def climbing(*given: Any, **options: Any) -> Any:
        begun.unlink()
        return climb(*given, **options)

    monkeypatch.setattr(tune, "climb", climbing)
    given = [
        "four-d",
        "--form",
        "speed",
        "--start",
        str(begun),
        "--generations",
        "1",
        "--draws",
        "2",
        "--out",
        str(out),
    ]
    assert tune.main(given) == 0
    kept = stored(str(out))
    assert (kept.start, kept.start_sha256) == ("begun.json", hashlib.sha256(text.encode()).hexdigest())


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--draws", "0"], "--draws"),
        (["--gain", "0"], "--gain"),
        (["--spread", "0"], "--spread"),
        (["--steps", "0"], "--steps"),
        (["--begin", "1,-1"], "levels and then switches"),
        (["--begin", "1,x,2"], "levels and then switches"),
        (["--start", "nowhere.json"], "nowhere.json"),
        (["--plant", "nothing"], "nothing"),
        (["--out", "."], "--out ."),
        (["--out", "nowhere/x.json"], "--out nowhere"),
    ],
)
def test_the_command_says_in_one_line_what_is_wrong(
    given: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tune.main(["four-d", "--draws", "2", "--out", str(tmp_path / "x.json"), *given]) != 0
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": 2}, "schema: expected 1, got 2"),
        ({"task": "none"}, "task: expected one of"),
        ({"shield": "none"}, "shield: expected one of worst case, belief, bounded, gaussian"),
        ({"form": "none"}, "form: expected one of"),
        ({"seed": 1.5}, "seed: expected a whole number"),
        ({"table": [[0.0] * TERMS] * 2}, "odd number of rows"),
        ({"table": [[0.0] * 3]}, f"expected a list of {TERMS}"),
        ({"more": 1}, "more: unknown key"),
    ],
)
def test_a_file_that_is_something_else_is_refused(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = tmp_path / "changed.json"
    path.write_text(json.dumps(json.loads(stored("four-d-speed").to_json()) | change), encoding="utf-8")
    with pytest.raises(UsageError, match=message):
        stored(str(path))


def test_a_file_from_before_there_were_two_shields_was_tuned_behind_the_worst_case() -> None:
    record = json.loads(stored("four-d-speed").to_json())
    del record["shield"]
    assert read_text(json.dumps(record), "here") == stored("four-d-speed")
    assert stored("four-d-speed").asked().shield == "worst case"


def test_what_is_no_reference_at_all_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="there are: four-"):
        stored("../secrets")
    with pytest.raises(UsageError, match="not valid JSON"):
        read_text("{", "here")
    (tmp_path / "binary.json").write_bytes(b"\xff")
    with pytest.raises(UsageError, match="not UTF-8"):
        stored(str(tmp_path / "binary.json"))


def test_a_stored_reference_is_an_actor_that_is_worth_the_same() -> None:
    draws = FOUR.draws(BENCH, 7, 3)
    actor = StatefulNetwork(actor_of(stored("four-d-affine"), BENCH))
    ranges = BENCH.range_set(FOUR.ranges)
    outcome = play(BENCH, ranges, FOUR.parameters, actor, draws, "euler", FOUR.conditions)
    # What is seen is rounded to single precision, and an experiment with sign() is chaotic in its last digits.
    expected = follow("four-d-affine", FOUR, BENCH, draws).values
    assert rung("", FOUR, outcome).values == pytest.approx(expected, abs=0.05)


def test_the_command_prints_a_ladder_with_an_oracle_and_which_sets_the_bench_covers(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["four-d", "--draws", "2", "--no-design", "--oracle", "--home", "0.2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("four-d: ")
    assert "2 brakes, shield 'envelope'" in lines[0]
    behind = following(FOUR)
    oracle = [line.split(",")[0] for line in lines if "ORACLE shield" in line]
    assert oracle == references_of(FOUR) + behind
    assert cli.main(["--wide"]) == 0
    first, *_, last = capsys.readouterr().out.splitlines()
    assert first == "±50%: covered"
    assert last.startswith("±80%: refused: ")
    assert last.endswith("; covered up to 35.8 rad")


def test_the_command_refuses_a_task_that_there_is_not(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["none"]) == 2
    assert "no task is called 'none'; there are: viscous, " in capsys.readouterr().err


def test_a_reference_that_was_tuned_on_another_plant_says_so() -> None:
    kept = dataclasses.replace(stored("four-d-speed"), plant="exact")
    assert kept.asked().plant == "exact"


def test_a_number_of_brakes_that_is_none_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--draws", "0"]) == 2
    assert "--draws: expected a number from 1" in capsys.readouterr().err
