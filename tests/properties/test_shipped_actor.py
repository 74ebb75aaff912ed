"""The shipped policies: they run on benches of one's own, and what is said of them holds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from emb_bench.commission.bench_file import MEASURED, found_text
from emb_bench.config.bench import Bench, parse_bench
from emb_bench.logs.log import read_log
from emb_runtime.config.bench import PARAMETER_NAMES, shipped_bench_text
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_train.closed_loop import Conditions
from emb_train.intervals import intervals
from emb_train.play import MEASURES, fresh_draws, of_actor, play

from tests.bench.commission.test_steps import LOGS, found, sheet_text  # isort: skip
from tests.runtime.operating import EmbRun  # isort: skip
from tests.train.trainings import constant  # isort: skip

PHYSICAL = Conditions(information="physical")


@pytest.mark.parametrize("quick", [False, True])
def test_a_shipped_file_fits_the_shipped_bench(bench: Bench, quick: bool) -> None:
    policy = load_policy(shipped_actor_path(quick), bench)
    assert (policy.warnings, len(policy.data) < 200_000) == ([], True)


def test_on_brakes_that_it_never_saw_it_returns_within_limits_with_narrower_intervals_than_constant_current(
    bench: Bench,
) -> None:
    ranges = bench.range_set("pm50")
    shipped = of_actor(load_policy(shipped_actor_path(), bench), bench)
    draws = fresh_draws(ranges, 1000, 20)
    actor, push = (
        play(bench, ranges, PARAMETER_NAMES, e, draws, conditions=PHYSICAL)
        for e in (shipped, constant(bench.limits.current))
    )
    for played in (actor, push):
        assert (int(played.violated.sum()), int(played.home.sum())) == (0, len(draws))  # the shield's doing
    brakes = [draw.brake for draw in draws]
    told, pushed = (intervals(bench, "exact", PARAMETER_NAMES, brakes, one.currents) for one in (actor, push))
    ratios = np.array([b.between_runs[:4] / a.between_runs[:4] for a, b in zip(told, pushed, strict=True)])
    assert np.median(ratios, axis=0).min() > 1.5
    assert (np.prod(ratios, axis=1) > 1.0).all()


OTHER_BENCHES = {
    "noise x 1.3": {"angle    = 1.0e-3 ": "angle    = 1.3e-3 ", "velocity = 1.0 ": "velocity = 1.3 "},
    "another f_v": {"f_v   = 2.160e-5 ": "f_v   = 3.0e-5 "},
    "another name": {'name = "drum brake, Guo 2024"': 'name = "mine"'},
    "other time-outs": {"stop_missed  = 20 ": "stop_missed  = 10 ", "watchdog         = 0.010 ": "watchdog = 0.008 "},
    "less speed": {"velocity = 500.0 ": "velocity = 400.0 "},
}


def test_it_runs_on_a_bench_of_ones_own_and_tells_as_much(bench: Bench) -> None:
    ranges, draws = bench.range_set("pm50"), fresh_draws(bench.range_set("pm50"), 5, 4)
    shipped = of_actor(load_policy(shipped_actor_path(), bench), bench)
    own = MEASURES["D"].values(play(bench, ranges, PARAMETER_NAMES, shipped, draws, conditions=PHYSICAL).matrices)
    for what, changes in OTHER_BENCHES.items():
        text = shipped_bench_text()
        for old, new in changes.items():
            assert old in text, what
            text = text.replace(old, new)
        mine = parse_bench(text, what)
        ranges = mine.range_set("pm50")
        policy = of_actor(load_policy(shipped_actor_path(), mine), mine)
        played = play(mine, ranges, PARAMETER_NAMES, policy, fresh_draws(ranges, 5, 4), conditions=PHYSICAL)
        assert (int(played.violated.sum()), int(played.home.sum())) == (0, 4), what
        lost = own - MEASURES["D"].values(played.matrices)
        assert lost.mean() < 3.0, what  # of four parameters 8 ln 1.3 = 2.1 are the noise's


def test_it_runs_with_the_bench_file_that_a_commissioning_writes(tmp_path: Path) -> None:
    sheet = parse_bench(sheet_text(), "sheet")
    bench = parse_bench(found_text(sheet, found(sheet), LOGS), "found")
    assert (bench.prior, bench.noise == sheet.noise) == (MEASURED, False)
    ranges = bench.range_set(MEASURED)
    push = constant(bench.limits.current)
    for quick in (False, True):
        policy = load_policy(shipped_actor_path(quick), bench)
        assert policy.warnings == ["velocity by sensor, made for one by observer"]
        both = [
            play(bench, ranges, PARAMETER_NAMES, e, fresh_draws(ranges, 5, 4), conditions=PHYSICAL)
            for e in (of_actor(policy, bench), push)
        ]
        for played in both:
            assert (int(played.violated.sum()), int(played.home.sum())) == (0, 4)
        more = MEASURES["D"].values(both[0].matrices) - MEASURES["D"].values(both[1].matrices)
        assert quick or (more > 1.0).all(), more  # the quick one is made for a tenth of a second


def test_the_first_run_of_a_newcomer_states_all_four_parameters_to_a_fiftieth_of_a_percent_and_is_right(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = EmbRun((), capsys, tmp_path / "run.mcap").document("--iface", "sim")
    assert (said["answered"], said["home"]) == (500, True)
    truth = read_log(tmp_path / "run.mcap").truth
    for name in PARAMETER_NAMES:
        found = said["estimate"][name]
        assert 2.0 * found["deviation"] < 2e-4 * found["value"]
        assert abs(found["value"] - getattr(truth, name)) < 4.0 * found["deviation"]


def test_quick_ends_in_about_a_tenth_of_a_second_with_all_four_parameters_within_two_percent_and_comes_home(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = EmbRun(("--quick",), capsys, tmp_path / "run.mcap")
    said = run.document("--iface", "sim:f_v=3e-5,k_1=20")
    assert (said["goal_reached"], said["home"]) == (True, True)
    assert said["goal_s"] < 0.13 < said["duration_s"] < 0.3
    truth = {"k_m": 0.0217, "k_1": 20.0, "T_c": 0.01037, "f_v": 3e-5}
    for name, value in truth.items():
        assert said["estimate"][name]["value"] == pytest.approx(value, rel=0.02)
    assert run.log().run["stop_when"] == "k_m=1.2%,k_1=1.2%,T_c=1.2%,f_v=1.2%"


def test_quick_ends_where_stop_when_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ends = []
    for goal in ("k_m=1%", "f_v=0.1%"):
        run = EmbRun(("--quick", "--stop-when", goal), capsys, tmp_path / f"{goal}.mcap")
        ends.append(run.document()["goal_s"])
        assert run.log().run["stop_when"] == goal
    assert ends[0] < ends[1]
