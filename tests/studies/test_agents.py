"""Statements about the thesis's agents, from a training to its sentence; short trainings."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats

from emb_bench.config.bench import load_bench
from emb_runtime.safety.shield_design import make_law
from emb_train.play import Draw
from emb_train.training import CONFIGURATION, METRICS, Training, begin_training, load_preset, run_training
from studies.thesis import agents, choices, pictures, trainings
from studies.thesis.agents import (
    FIGURES,
    correlation,
    drops_at_limits,
    number,
    on_grid,
    phases,
    rises_early,
    smoothed,
    square_wave,
)
from studies.thesis.cli import TRAININGS, main
from studies.thesis.stacked import train_together
from studies.thesis.trainings import AGENT, Trainings
from tests.commands import refused

BENCH = load_bench()


def small(name: str, **changes: Any) -> Training:
    """A preset that trains in a moment."""
    preset = load_preset(name, **changes)
    horizon, steps = preset.conditions.applied(BENCH).timing.horizon, min(500, preset.ppo.total_steps)
    ppo = {"total_steps": steps, "envs": 1, "rollout": horizon, "minibatch": 500, "epochs": 1, "hidden": [8, 8]}
    return load_preset(name, **changes | {"ppo": ppo})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The trainings of all targets, once; small presets stay until the module's end."""
    folder = tmp_path_factory.mktemp("trainings")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainings, "load_preset", small)
        assert main(["trainings", "--seeds", "2", "--json", "--output", str(folder)]) == 0
    return folder


@pytest.fixture
def made(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Trainings:
    """Finished trainings; none is made anew."""

    def refuse(*_: Any) -> None:
        raise AssertionError("trained again")

    monkeypatch.setattr(trainings, "load_preset", small)
    monkeypatch.setattr(trainings, "train_together", refuse)
    return Trainings(folder, BENCH, (0, 1), None, lambda _: None)


@pytest.mark.slow
def test_every_target_has_statements_of_its_own_trainings_which_are_made_once(
    folder: Path, made: Trainings, capsys: pytest.CaptureFixture[str]
) -> None:
    assert set(TRAININGS) == set(FIGURES)
    facts = [fact for figure in FIGURES for fact in agents.agent_facts(figure, made)]
    assert len(facts) == 37 + 7 + 2  # those of docs/studies/reproduction.md, Table 6.2, and section 6.2.1
    assert all(fact.found and fact.agrees in (True, False) for fact in facts)
    both = ("e-optimal-hybrid", "e-optimal-trajectory", "trajectory-a", "trajectory-b")
    once = ("adaptive", "d-optimal-1", "d-optimal-2", "d-optimal-plain", "fixed", "random")
    names = [f"thesis-{n}-{s}" for n in both for s in (0, 1)] + [f"thesis-{n}-0" for n in once]
    assert sorted(path.name for path in folder.iterdir()) == sorted(names)
    assert main(["fig-5.2", "fig-4.2", "--output", str(folder)]) == 0
    assert capsys.readouterr().out.count("fig-") == 2


def test_trainings_at_once_are_those_alone_but_for_rounding(tmp_path: Path) -> None:
    sizes = {"total_steps": 2000, "envs": 2, "rollout": 500, "minibatch": 250, "epochs": 2, "hidden": [8, 8]}
    together = {
        tmp_path / f"{deviation}-{seed}": trainings.Choice(deviation=deviation).applied(
            load_preset("thesis-trajectory-b", seed=seed, **sizes), BENCH.limits.current
        )
        for deviation in (1.0, 6.0)
        for seed in (0, 1)
    }
    actors = dict(train_together(together, BENCH))
    for folder, config in together.items():
        begin_training(alone := tmp_path / f"{folder.name}-alone", config, BENCH)
        *_, best = run_training(alone, config, BENCH)
        for ours, its in zip(actors[folder].parameters(), best.actor.parameters(), strict=True):
            np.testing.assert_allclose(ours.detach(), its.detach(), atol=1e-5)
        lines = [[json.loads(line) for line in (f / METRICS).read_text().splitlines()] for f in (folder, alone)]
        for ours, its in zip(*lines, strict=True):
            assert ours == pytest.approx({name: its[name] for name in ours}, rel=1e-3)
    assert len({float(actor.log_deviation.detach()) for actor in actors.values()}) == 4


def test_a_wrong_option_is_refused_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["fig-1.1"], ["--seeds", "0"], ["--steps", "-5"], ["--seed", "-1"]):
        refused(lambda: main([*arguments, "--output", str(tmp_path / "new")]), capsys)  # noqa: B023  # called at once
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_trainings_that_do_not_belong_to_a_target_are_refused_in_a_line(
    folder: Path, made: Trainings, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    refused(lambda: main(["fig-5.2", "--steps", "300", "--output", str(folder)]), capsys)  # of other trainings
    for content in ("junk\n", '{"steps": 1}\n', "\xff"):
        shutil.rmtree(tmp_path / "thesis-fixed-0", ignore_errors=True)
        copy = shutil.copytree(folder / "thesis-fixed-0", tmp_path / "thesis-fixed-0")
        (copy / METRICS).write_bytes(content.encode("latin-1"))
        refused(lambda: main(["fig-5.3", "--output", str(tmp_path)]), capsys)


@pytest.mark.slow
def test_an_interrupted_training_is_made_anew_and_another_folder_is_left_alone(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(trainings, "load_preset", small)
    cut = shutil.copytree(folder / "thesis-fixed-0", tmp_path / "thesis-fixed-0")
    (cut / METRICS).write_text("")
    (cut / AGENT).unlink()
    assert main(["fig-5.2", "--output", str(tmp_path)]) == 0
    assert (cut / METRICS).read_text()
    foreign = tmp_path / "other" / "thesis-fixed-0"
    foreign.mkdir(parents=True)
    (foreign / "mine.txt").write_text("kept")
    refused(lambda: main(["fig-5.2", "--output", str(tmp_path / "other")]), capsys)
    assert (foreign / "mine.txt").read_text() == "kept"


@pytest.mark.slow
def test_choices_are_counted_seed_by_seed_as_far_as_the_time_allows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(trainings, "load_preset", small)
    arguments = ["fig-5.3", "--choices", "--seeds", "2", "--output", str(tmp_path)]
    assert main([*arguments, "--minutes", "1e-9"]) == 0
    assert "more --minutes" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())
    assert main([*arguments, "--json"]) == 0
    counts = json.loads(capsys.readouterr().out)
    assert [(c["seed"], c["deviation"], c["tracking"]) for c in counts] == [
        (seed, deviation, tracking) for seed in (0, 1) for deviation in (1.0, 6.0) for tracking in (1.0, 0.1)
    ]
    # The reward of these agents follows no quintic: both weights have one training.
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("thesis-*")) == [
        f"{folder}thesis-fixed-{seed}" for folder in ("deviation=6.0/", "") for seed in (0, 1)
    ]
    started = json.loads((tmp_path / "deviation=6.0/thesis-fixed-0" / CONFIGURATION).read_text())
    assert started["ppo"]["initial_deviation"] == 1.0  # of ±6 A
    assert main([*arguments, "--minutes", "1e-9"]) == 0  # nothing is trained again
    assert "of 4" in capsys.readouterr().out


def test_a_table_of_choices_has_the_share_of_all_and_says_if_they_cannot_be_compared() -> None:
    counts = [choices.Count(a, w, "fig-5.3", seed, 3 if a > 1.0 else 1, 4) for a in (1.0, 6.0) for w in (1.0, 0.1)
              for seed in (0, 1)]  # fmt: skip
    table = choices.text(counts)
    assert "1, 1 of 4" in table
    assert "3, 3 of 4" in table
    assert table.splitlines()[-1].split() == ["agree", "25", "%", "25", "%", "75", "%", "75", "%"]
    assert "cannot be compared" in choices.text(counts[:-1])


def test_a_choice_that_there_is_not_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for said, words in (
        ("devation=6", "did you mean deviation?"),
        ("deviation", "as in deviation=6"),
        ("deviation=0", "deviation"),
        ("deviation=nan", "deviation"),
        ("tracking=-1", "tracking"),
        ("draws=poisson", "draws"),
    ):
        line = refused(lambda: main(["fig-5.2", "--set", said, "--output", str(tmp_path)]), capsys)  # noqa: B023
        assert words in line
    assert "--choices" in refused(lambda: main(["fig-4.2", "--choices"]), capsys)
    assert "--minutes" in refused(lambda: main(["fig-5.2", "--minutes", "nan"]), capsys)
    assert choices.set_choice(["draws=normal", "deviation=6"]) == trainings.Choice(deviation=6.0, draws="normal")


def test_figures_that_need_no_training_are_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--figures", str(tmp_path / "new")]) == 0
    files = sorted((tmp_path / "new").iterdir())
    assert [file.stem for file in files] == sorted(pictures.ANALYSIS)
    assert capsys.readouterr().out.split() == [str(file) for file in files]
    assert all(file.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" for file in files)
    assert "fig-6.9" in refused(lambda: main(["fig-6.9", "--figures", str(tmp_path)]), capsys)


@pytest.mark.slow
def test_figures_of_trained_agents_are_drawn(made: Trainings, folder: Path, tmp_path: Path) -> None:
    assert main(["trainings", "--seeds", "2", "--figures", str(tmp_path), "--output", str(folder)]) == 0
    assert sorted(file.stem for file in tmp_path.iterdir()) == list(pictures.TRAINED)


def test_an_ellipse_is_where_the_deviation_has_its_quantile() -> None:
    covariance = np.array([[4.0, 1.5], [1.5, 1.0]])
    edge = pictures.ellipse(covariance)
    distances = np.einsum("in,ij,jn->n", edge, np.linalg.inv(covariance), edge)
    np.testing.assert_allclose(distances, scipy.stats.chi2.ppf(0.95, 2), rtol=1e-3)


def test_the_bench_of_table_6_1_covers_its_brakes_and_is_else_the_shipped_one(tmp_path: Path) -> None:
    path = tmp_path / "table-6.1.toml"
    assert main(["--write-bench", str(path)]) == 0
    bench = load_bench(path)
    make_law(bench)
    drawn = BENCH.range_set("viscous-stiffness")
    low, high = ({"k_1": end.k_1, "f_v": end.f_v} for end in (drawn.low, drawn.high))
    for name in (bench.shield.ranges, bench.prior):
        box = bench.range_set(name)
        assert not box.uncovered(bench.brake._replace(**low), bench.brake._replace(**high))
    assert bench.brake == BENCH.brake._replace(k_1=0.5 * (low["k_1"] + high["k_1"]))
    assert (bench.limits, bench.noise, bench.timing) == (BENCH.limits, BENCH.noise, BENCH.timing)


@pytest.mark.slow
def test_a_cut_training_makes_a_rehearsal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(trainings, "load_preset", small)
    assert main(["fig-5.2", "--steps", "300", "--output", str(tmp_path)]) == 0
    assert "no verdict of a training counts" in capsys.readouterr().out


@pytest.mark.slow
def test_agents_that_leave_the_limits_at_once_get_a_verdict_like_any_other(
    made: Trainings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trainings.Training, "agent", lambda _, batch: np.full(len(batch.experiments.k), 6.0))
    for figure in ("fig-5.3", "fig-5.4", "fig-5.6", "table-6.2"):
        assert agents.agent_facts(figure, made)
    assert [f.found for f in agents.agent_facts("table-6.2", made)][2] == "100 (2 seeds: 100 to 100)"  # violations
    (way,), (home, *_) = (agents.agent_facts(figure, made) for figure in ("fig-5.7", "fig-5.8"))
    assert (way.agrees, way.found) == (False, "none of 5 got to 300 ms")
    assert (home.agrees, home.found[:6]) == (False, "0 of 5")


@pytest.mark.slow
def test_a_way_home_agrees_if_it_keeps_the_limits_and_the_agent_takes_it(
    made: Trainings, monkeypatch: pytest.MonkeyPatch
) -> None:
    for fastest, apart, until, verdicts in (
        (400.0, 4.0, 201, [True, True]),
        (501.0, 4.0, 201, [False, True]),
        (400.0, 6.0, 201, [True, False]),
        (400.0, 4.0, 5, [True, False]),  # one leaves the limits soon after 300 ms
    ):
        way = np.zeros((201, 5, 2))
        way[:, :, 0], way[100, 2, 1] = np.linspace(70.0, 0.0, 201)[:, None], -fastest
        taken = way + np.array([apart, 0.0])
        taken[until:, 0] = math.nan
        monkeypatch.setattr(agents, "ways_home", lambda _, ways=(way, taken): ways)
        assert [agrees for *_, agrees in agents.fig_5_7(made)] == verdicts


def test_numbers_and_courses_agree_by_the_rules_that_the_page_states() -> None:
    for printed, ours, agrees in (
        (100.0, [119.0], True),
        (100.0, [121.0], False),
        (100.0, [60.0, 150.0], True),  # the mean decides, however far the seeds scatter
        (-100.0, [100.0], False),
        (0.0, [0.0, 0.0], True),
        (0.0, [0.0, 40.0, 60.0], False),
    ):
        assert number(printed, ours, "x")[2] is agrees, (printed, ours)
    assert number(3.0, [1.0, 3.0, 5.0], "x")[1] == "3 (3 seeds: 1 to 5)"
    steady = np.linspace(0.0, 100.0, 101)
    rising = np.minimum(4.0 * steady, 100.0)
    assert [rises_early([curve])[2] for curve in (steady, rising, -rising)] == [False, True, False]
    assert correlation(steady, np.zeros(101)) == 0.0
    assert correlation(steady, -2.0 * steady) == pytest.approx(-1.0)
    np.testing.assert_allclose(smoothed(np.arange(100.0))[10:90], np.arange(10.0, 90.0))
    assert smoothed(np.arange(100.0))[0] == pytest.approx(1.0)  # of 0, 1, 2


def test_a_return_drops_at_the_limits_if_an_experiment_left_them_in_most_of_the_later_drops() -> None:
    for depth, left, agrees in (
        (0.1, [50, 70, 90], True),
        (0.1, [50, 70], True),
        (0.1, [50], False),
        (0.1, [40, 60, 80], False),  # where it does not drop
        (0.1, [10], False),  # in the first part of the training
        (0.01, [50, 70, 90], False),  # not a drop
    ):
        curve, violations = np.full(100, 100.0), np.zeros(100)
        curve[[10, 50, 70, 90]] *= 1.0 - depth
        violations[left] = 2.0
        assert drops_at_limits(curve, violations)[2] is agrees, left


@pytest.mark.slow
def test_an_experiment_is_recorded_until_it_leaves_the_limits(made: Trainings) -> None:
    fixed, draws = made.first("thesis-fixed"), [Draw(0, BENCH.brake), Draw(1, BENCH.brake)]
    runs = fixed.run(draws, lambda batch: np.array([6.0, 0.0]))
    assert runs.violated.tolist() == [True, False]
    steps = int((~np.isnan(runs.current[:, 0])).sum())
    assert abs(runs.x[steps, 0, 1]) > 500.0
    assert np.isnan(runs.x[steps + 1 :, 0]).all()
    assert not np.isnan(runs.x[:, 1]).any()
    assert runs.last[0, 0] == runs.information[steps - 1, 0, 0]
    assert runs.returns[0] == pytest.approx(runs.information[steps - 2, 0, 0] - 4e4)  # in its own unit
    current = made.first("thesis-d-optimal-1").run([Draw(0, BENCH.brake)], square_wave).current[:, 0]
    np.testing.assert_array_equal(current, np.tile(np.repeat([6.0, -6.0], 10), 15))  # a period of 20 ms
    trajectory = made.first("thesis-trajectory-b")
    assert phases(trajectory).sum() == pytest.approx(on_grid(trajectory).returns.mean())
