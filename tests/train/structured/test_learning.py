"""The runtime's learning shield in trials: what it holds, what it is worth, where it is refused."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import pytest

from emb_bench.config.bench import load_bench
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError
from emb_train.closed_loop import Conditions
from emb_train.reference import stored
from emb_train.trial import TASKS, Trials

BENCH = load_bench()
FOUR = TASKS["four-d"]


@pytest.mark.parametrize("plant", ["exact", "euler"])
def test_behind_the_shield_that_learns_the_limits_hold_the_truth_stays_possible_and_more_is_told(plant: str) -> None:
    kept, scores = stored("four-d-exact-quadratic"), []
    for shield in ("worst case", "bounded"):
        task = replace(FOUR, plant=plant, shield=shield)
        (found,) = task.trials(BENCH, task.draws(BENCH, 6, 24)).play(kept.scale(BENCH), kept.array()[None])
        assert not found.left.any()
        assert found.home.all()
        assert not found.mistaken.any()
        scores.append(task.score(found))
    assert (scores[1] - scores[0]).mean() > 0.1


def test_a_truth_outside_of_what_was_learnt_is_counted() -> None:
    draws = FOUR.draws(BENCH, 6, 4)
    strong = [d._replace(brake=d.brake._replace(k_m=2.0 * BENCH.brake.k_m)) for d in draws]  # the set ends at 1.5
    trials = replace(FOUR, shield="bounded").trials(BENCH, strong)
    kept = stored("four-d-exact-quadratic")
    (found,) = trials.play(kept.scale(BENCH), kept.array()[None])
    assert found.mistaken.all()


def test_a_shield_that_learns_is_refused_where_its_model_is_not_the_brake_s() -> None:
    shields: list[dict[str, Any]] = [
        {"frame_age": (0, 1)},
        {"current_lag": 5e-4},
        {"envelope": "coasting", "angle_margin": 1.1},
    ]
    cases = [(BENCH, plant, (0, 0)) for plant in ("late", "lag", "offset", "observer", "rough")]
    cases += [(replace(BENCH, shield=BENCH.shield._replace(**s)), "exact", (0, 0)) for s in shields]
    for bench, plant, delay in [*cases, (BENCH, "exact", (0, 1))]:
        for shielded in (True, False):
            conditions = Conditions(shielded=shielded, command_delay=delay)
            begin = partial(Trials, bench, bench.range_set("pm50"), PARAMETER_NAMES, [], plant, conditions)
            with pytest.raises(UsageError):
                begin(shield="bounded")
            begin()
    for plant in ("euler", "exact", "stribeck", "jitter"):
        replace(FOUR, plant=plant, shield="bounded").trials(BENCH, [])
