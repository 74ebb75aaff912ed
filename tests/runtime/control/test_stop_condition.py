"""The running estimate in a run, and how a run ends early by it."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.cli.replay import main as emb_replay
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, Sensors, load_bench
from emb_runtime.control.phases import HOME_PAIRS
from emb_runtime.control.stop_condition import REACHED, parse_stop_condition
from emb_runtime.errors import UsageError
from emb_runtime.estimator.estimate import LOST
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.records import Reason
from emb_runtime.safety.state_machine import Fault
from tests.actors import constant_actor
from tests.conftest import FunctionActor, SimRun, Simulate
from tests.runtime.operating import EmbRun

BENCH = load_bench()
BOX = BENCH.range_set(BENCH.shield.ranges)
TWO = ("k_1", "f_v")


class At:
    """A stop condition that is reached at a sample, whatever is estimated."""

    def __init__(self, at: int) -> None:
        self.left = at + 1

    def reached(self, _estimate: Sequence[float]) -> bool:
        self.left -= 1
        return self.left <= 0

    def describe(self, _estimate: Sequence[float]) -> str:
        return "by count"


LAWS: dict[str, Callable[[float, float, float], float]] = {
    "forward": lambda *_: 6.0,
    "backward": lambda *_: -6.0,
    "away": lambda y, v, k: math.copysign(6.0, y),
    "faster": lambda y, v, k: math.copysign(6.0, v),
    "square": lambda y, v, k: 6.0 if k // 20 % 2 == 0 else -6.0,
}


def ended(simulate: Simulate, law: str, step: int, options: str = "") -> SimRun:
    return simulate(actor=FunctionActor(LAWS[law]), stop_condition=At(step), options=options)


def test_the_loop_estimates_along_whatever_the_policy_is_and_records_each_estimate(simulate: Simulate) -> None:
    run = simulate(actor=FunctionActor(LAWS["square"]))
    estimator = Estimator(BENCH)
    for cycle, (time_ns, step, estimate) in zip(run.journal.cycles[:-1], run.journal.estimates, strict=True):
        estimator.add_sample(cycle.angle, cycle.velocity, cycle.step, cycle.applied_current)
        assert (time_ns, step, estimate) == (cycle.receive_time_ns, cycle.step, estimator.estimate)
    assert run.outcome.estimate == run.journal.estimates[-1][2]
    for value, deviation, true in zip(estimate[:4], estimate[4:], BENCH.brake[2:], strict=True):
        assert abs(value - true) < 4.0 * deviation < 0.2 * true
    assert not run.outcome.goal_reached


def test_the_model_fits_an_observer_that_is_declared(simulate: Simulate) -> None:
    run = simulate(
        actor=FunctionActor(LAWS["square"]),
        on_bench=dataclasses.replace(BENCH, sensors=Sensors("observer", 1520.0)),
        options="plant=observer",
    )
    assert (run.outcome.fault, run.outcome.model_fits) == (None, True)
    values, deviations, true = run.outcome.estimate[:4], run.outcome.estimate[4:], BENCH.brake[2:]
    errors = [abs(value - brake) for value, brake in zip(values, true, strict=True)]
    assert all(error < 4.0 * known < 0.2 * b for error, known, b in zip(errors, deviations, true, strict=True))


def test_on_the_way_home_and_where_the_bench_leaves_nothing_open_nothing_is_recorded(simulate: Simulate) -> None:
    run = simulate(homing=True)
    assert (run.journal.estimates, run.outcome.estimate, run.outcome.goal_reached) == ([], (), False)
    run = simulate(on_bench=dataclasses.replace(BENCH, prior="nominal"))
    assert (run.journal.estimates, run.outcome.estimate) == ([], ())


def test_an_estimate_that_is_not_finite_any_more_is_none_and_said_once(simulate: Simulate) -> None:
    sharp = dataclasses.replace(BENCH, noise=dataclasses.replace(BENCH.noise, angle=1e-30, velocity=1e-30))
    run = simulate(actor=FunctionActor(LAWS["square"]), on_bench=sharp)
    assert run.journal.codes.count(LOST) == 1
    assert 0 < len(run.journal.estimates) < len(run.journal.cycles) - 1
    assert (run.outcome.estimate, run.outcome.goal_reached) == ((), False)


def test_a_condition_is_reached_when_each_repeatability_is_below_its_part_of_the_value() -> None:
    condition = parse_stop_condition(" k_1 = 1%, f_v=50 % ", TWO)
    assert condition.parts == ((1, 0.01), (3, 0.5))

    def numbers(k_1: float, f_v: float, k_1_half: float, f_v_half: float) -> tuple[float, ...]:
        return 1.0, k_1, 1.0, f_v, 9.0, k_1_half / 1.96, 9.0, f_v_half / 1.96

    assert condition.reached(numbers(-2.0, 1.0, 0.0199, 0.49))
    assert not condition.reached(numbers(-2.0, 1.0, 0.0201, 0.49))
    assert not condition.reached(numbers(-2.0, 1.0, 0.0199, 0.51))
    assert not condition.reached(numbers(0.0, 1.0, 0.0, 0.1))
    assert not condition.reached(numbers(-2.0, 1.0, 0.0, 0.49)), "what is certain was not measured"
    assert condition.describe(numbers(-2.0, 1.0, 0.019, 0.4)) == (
        "repeatability k_1 ± 0.95 % of 1 %, f_v ± 40 % of 50 %"
    )
    assert parse_stop_condition("f_v=5%", TWO).reached(numbers(1.0, 1.0, 1e9, 0.04))


def test_what_is_no_condition_is_refused_in_one_line() -> None:
    wrong = ["", "k_1", "k_1=1", "k_1=%", "k_1=0%", "k_1=-1%", "k_1=101%", "k_1=nan%", "k_1=inf%", "k_1=1%%", "k_1=1%,"]
    for text in (*wrong, "T_c=1%", "k_1=1%,k_1=2%", "k_1=1%;f_v=2%", "=1%"):
        with pytest.raises(UsageError, match=r"--stop-when: ") as caught:
            parse_stop_condition(text, TWO)
        assert "\n" not in str(caught.value)
    with pytest.raises(UsageError):
        parse_stop_condition("k_1=1%", ())


def test_once_it_is_reached_the_brake_comes_home_and_it_ends(simulate: Simulate) -> None:
    lengths = {}
    for law in LAWS:
        for at in (0, 60, 150, 480, 499) if law == "forward" else (150, 400):
            run = ended(simulate, law, at)
            assert (run.outcome.fault, run.outcome.home, run.outcome.goal_reached) == (None, True, True)
            assert run.journal.codes == ["SILENT", "ARMED", "ACTIVE", REACHED, "STOPPING", "OVER"]
            cycles = run.journal.cycles
            last = lengths[law, at] = cycles[-1].step
            assert last == 500 or all(abs(c.angle) <= BENCH.shield.home_angle for c in cycles[-HOME_PAIRS:])
            after = [c for c in cycles if at < c.step < last]
            assert all(c.reasons & Reason.RETURNING and c.clipped_current == 0.0 for c in after)
            assert all(c.policy_current == pytest.approx(LAWS[law](c.angle, c.velocity, c.step)) for c in after)
            assert all(not c.reasons & Reason.CLIPPED for c in after)
            assert [step for _, step, _ in run.journal.estimates] == [c.step for c in cycles[:-1]]
            assert -10.0 <= run.outcome.counters.angle_min <= run.outcome.counters.angle_max <= 100.0
            assert run.outcome.counters.top_speed <= 510.0  # measured
    early = [lengths["forward", at] for at in (0, 60, 150)]
    assert early == sorted(early)
    assert all(at + HOME_PAIRS <= lengths["forward", at] < 500 for at in (0, 60, 150))
    never = ended(simulate, "forward", 10_000)
    assert not never.outcome.goal_reached
    assert never.journal.cycles[-1].step == 500


@given(
    corner=st.tuples(*(st.sampled_from((getattr(BOX.low, n), getattr(BOX.high, n))) for n in PARAMETER_NAMES)),
    at=st.integers(0, 499),
    law=st.sampled_from(sorted(LAWS)),
    plant=st.sampled_from(["euler", "exact"]),
)
@settings(max_examples=12)
def test_every_corner_of_the_set_comes_home_within_its_limits(
    simulate: Simulate, corner: tuple[float, ...], at: int, law: str, plant: str
) -> None:
    theta = ",".join(f"{name}={value!r}" for name, value in zip(PARAMETER_NAMES, corner, strict=True))
    outcome = ended(simulate, law, at, f"plant={plant},{theta}").outcome
    assert (outcome.fault, outcome.home, outcome.goal_reached) == (None, True, True)


def test_a_policy_that_answers_no_number_on_the_way_home_is_stopped_as_ever(simulate: Simulate) -> None:
    actor = FunctionActor(lambda _y, _v, k: math.nan if k == 90 else 6.0)
    run = simulate(actor=actor, stop_condition=At(80))
    assert (run.outcome.fault, run.outcome.goal_reached) == (Fault.POLICY_NOT_FINITE, True)


# emb-run --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def steady(
    tmp_path: Path, bench: Bench, handlers: None, one_process: None, capsys: pytest.CaptureFixture[str]
) -> EmbRun:
    path = tmp_path / "steady.onnx"
    path.write_bytes(constant_actor(bench, 3.0))
    return EmbRun(("--policy", str(path)), capsys, tmp_path / "run.mcap")


def test_a_run_is_logged_with_its_estimates_and_decides_the_same_again(
    steady: EmbRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.mcap"
    summary = steady.document()
    assert (summary["answered"], summary["home"], summary["goal_reached"]) == (500, True, False)
    assert summary["estimate"]["k_m"]["value"] == pytest.approx(BENCH.brake.k_m, rel=1e-2)
    log = steady.log()
    table = log.tables["/estimate"]
    assert [*table][3:9] == ["step", "k_m", "k_1", "T_c", "f_v", "k_m_deviation"]
    assert table["step"].tolist() == list(range(500))
    assert table["publish_time"].tolist() == log.cycles["publish_time"][:500].tolist()
    assert (np.diff(table["k_m_deviation"]) < 1e-4 * BENCH.brake.k_m).all()
    assert emb_replay(["rerun", str(path)]) == 0
    assert capsys.readouterr().out.startswith("reproduced   each of 501 decisions, 503 sent frames")
    assert emb_replay(["info", str(path)]) == 0
    assert "\n  f_v = " in capsys.readouterr().out
    assert emb_replay(["info", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["estimate"] == summary["estimate"]


def test_it_ends_early_where_that_is_asked_for(
    steady: EmbRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.mcap"
    out = steady.text("--stop-when", "k_m=1%")
    answered = re.match(r"done: (\d+) of 500 samples answered, precise after 0\.\d+ s, then home\n", out)
    assert answered is not None
    assert HOME_PAIRS < int(answered[1]) < 500
    log = steady.log()
    assert log.run["stop_when"] == "k_m=1%"
    assert (log.exit_reason, log.end["goal_reached"]) == ("DONE", "True")
    (event,) = (event for event in log.events if event.code == REACHED)
    assert event.text.startswith("repeatability k_m ± 0.9")
    assert emb_replay(["rerun", str(path)]) == 0
    assert f"reproduced   each of {int(answered[1]) + 1} decisions" in capsys.readouterr().out
    for command in ("fim", "timing", "info", "estimate --starts 1", f"report --starts 1 -o {tmp_path / 'page.html'}"):
        assert emb_replay([*command.split(), str(path)]) in (0, 2), command
        describe = capsys.readouterr()
        assert "the experiment ends after" not in describe.out + describe.err, command
        assert "did not come to its end" not in describe.err, command
