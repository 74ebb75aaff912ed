"""The search for a plan, with few plans and brakes."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from emb_bench.config.bench import load_bench
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.estimator.speed_loop import scale_of
from emb_train import plan
from emb_train.cli import main
from emb_train.evolve import Progress
from emb_train.plan import PRICE, Compared, numbers_of, search, table_of
from emb_train.play import MEASURES
from emb_train.reference import TERMS, stored
from emb_train.trial import TASKS, Task

BENCH = load_bench()
FOUR, SCALE = TASKS["four-t"], scale_of(BENCH)


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few plans on few brakes, in this process."""
    sizes = {"DRAWN": 6, "SCREENINGS": 2, "SCREENED": 1, "KEPT": 3, "BRAKES": 2, "JUDGED": 2, "POPULATION": 4}
    for name, value in sizes.items():
        monkeypatch.setattr(plan, name, value)
    monkeypatch.setattr(plan, "processes", lambda jobs: nullcontext())


@given(arrays(np.float64, 10, elements=st.floats(-1.05, 1.05)))
def test_a_plan_has_levels_up_to_full_speed_and_switches_in_order(numbers: Floats) -> None:
    table = table_of(numbers)
    assert table.shape == (9, TERMS)
    assert not table[:, 1:].any()
    assert (np.abs(table[:5, 0]) <= 1.0).all()
    assert (table[:5, 0] * numbers[:5] >= 0.0).all()
    assert (np.diff(table[5:, 0], prepend=0.0, append=1.0) > 0.0).all()


@given(arrays(np.float64, 10, elements=st.floats(-0.3, 0.3)))
def test_a_search_that_goes_on_begins_with_the_plan_that_it_was_given(numbers: Floats) -> None:
    np.testing.assert_allclose(table_of(numbers_of(table_of(numbers))), table_of(numbers), atol=1e-9)


def test_a_plan_is_judged_by_the_interval_and_pays_for_each_brake_that_does_not_come_home() -> None:
    compared = Compared(FOUR, BENCH, SCALE, None, 5, 3)
    (score,), (outcome,) = compared.scores(np.array([[0.9, -0.9, -0.1, 0.2, 0.2, 0.1]]))
    brakes = [draw.brake for draw in FOUR.draws(BENCH, 5, 3)]
    (values,) = MEASURES["T"].of_outcomes(BENCH, "exact", PARAMETER_NAMES, brakes, [outcome])
    assert outcome.home.all()
    assert score == pytest.approx(values.mean())
    outcome.home[1] = False
    assert np.mean(values - PRICE * ~outcome.home) == pytest.approx(score - PRICE / 3.0)


def test_a_search_returns_a_plan_that_is_worth_more_than_it_began_with() -> None:
    seen: list[Progress] = []
    begin = table_of(np.array([0.5, -0.5, 0.1, 0.0, 0.0, 0.0]))
    found = search(FOUR, BENCH, SCALE, begin, steps=4, seed=3, show=seen.append)
    assert [step.steps for step in seen] == [1, 2, 3, 4]
    assert {step.played for step in seen} == {8}
    fresh = Compared(FOUR, BENCH, SCALE, None, 77, 4)
    scores, _ = fresh.scores(np.stack([numbers_of(found.table), numbers_of(begin)]))
    assert scores[0] > scores[1]
    again = search(FOUR, BENCH, SCALE, begin, steps=4, seed=3)
    assert again.table.tolist() == found.table.tolist()


def test_a_search_that_is_interrupted_keeps_the_best_plan_so_far() -> None:
    def press(step: Progress) -> None:
        if step.steps == 2:
            raise KeyboardInterrupt

    found = search(FOUR, BENCH, SCALE, table_of(np.zeros(6)), steps=9, seed=3, show=press)
    assert found.steps == 2
    assert found.table.shape == (5, TERMS)


def test_the_command_finds_a_plan_by_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "mine"
    assert main(["reference", "four-t", "--steps", "1", "--output", str(folder)]) == 0
    kept = stored(str(folder / "reference.json"))
    assert (kept.task, kept.form, kept.plant, len(kept.table)) == ("four-t", "blind", "exact", 2 * plan.LEVELS - 1)
    assert Task.of(kept).measure is MEASURES["T"]
    assert f"{kept.score:.6g}" in capsys.readouterr().out
    metrics = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [(line["steps"], line["played"]) for line in metrics] == [(0, 3), (0, 3), (1, 8)]


def test_a_plan_that_depends_on_the_estimate_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reference", "four-t", "--form", "quadratic", "--output", str(tmp_path / "x")]) == 2
    assert "--form: expected blind" in capsys.readouterr().err
