"""The running estimate in a log: read, compared when the loop decides again, and refused if its topic is another."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from emb_bench.logs.estimates import by_step, last_estimate
from emb_bench.logs.info import info_document
from emb_bench.logs.log import RunLog, read_log
from emb_bench.rerun import Rerun, rerun
from emb_runtime.can.messages import Layout
from emb_runtime.config.bench import Bench
from emb_runtime.control.stop_condition import parse_stop_condition
from emb_runtime.errors import LogError
from emb_runtime.estimator.estimate import LOST
from emb_runtime.estimator.estimator import estimated
from emb_runtime.log.ring_buffer import EstimateRecord, EventRecord, Record

from tests.bench.conftest import Replay  # isort: skip
from tests.actors import constant_actor
from tests.bench.hostile import write_trace
from tests.conftest import FunctionActor, Journal, SimRun, Simulate
from tests.corrupt import rewritten, with_field, without

STEPS = 300
STOP_WHEN = "k_m=1%"
ACTOR = FunctionActor(lambda *_: 3.0)

Write = Callable[..., Path]
Alter = Callable[[list[Record]], None]


@pytest.fixture(scope="module")
def driven(simulate: Simulate, bench: Bench) -> tuple[SimRun, list[Record]]:
    """A run that ended early, and its records in order."""
    journal = Journal()
    stop_condition = parse_stop_condition(STOP_WHEN, estimated(bench))
    run = simulate(actor=ACTOR, steps=STEPS, journal=journal, stop_condition=stop_condition)
    assert (run.outcome.fault, run.outcome.goal_reached) == (None, True)
    return run, journal.records


@pytest.fixture
def write(driven: tuple[SimRun, list[Record]], bench: Bench, layout: Layout, tmp_path: Path) -> Write:
    """Writes its log, altered if asked for."""

    def written(alter: Alter = lambda records: None, cut: bool = False, stop_when: str = STOP_WHEN) -> Path:
        run, records = driven[0], list(driven[1])
        alter(records)
        return write_trace(
            tmp_path / "run.mcap",
            records,
            bench,
            layout,
            None if cut else run.outcome,
            steps=STEPS,
            policy=constant_actor(bench, 3.0),
            stop_when=stop_when,
        )

    return written


def again(path: Path, bench: Bench) -> Rerun:
    return rerun(read_log(path), ACTOR, 6.0, parse_stop_condition(STOP_WHEN, estimated(bench)))


def estimates(records: list[Record]) -> list[int]:
    return [n for n, record in enumerate(records) if isinstance(record, EstimateRecord)]


def test_all_of_them_are_read_with_their_names_and_units(write: Write, driven: tuple[SimRun, list[Record]]) -> None:
    log, records = read_log(write()), [r for r in driven[1] if isinstance(r, EstimateRecord)]
    assert by_step(log) == {record.step: record.numbers for record in records}
    said = last_estimate(log)
    assert list(said) == ["k_m", "k_1", "T_c", "f_v"]
    value, deviation = records[-1].numbers[3::4]
    half = 1.959964 * deviation
    assert said["f_v"] == {
        "value": value, "deviation": deviation, "repeatability": pytest.approx(half),
        "total": pytest.approx(math.hypot(half, 1.959964 * 0.01 * value)), "unit": "N·m·s/rad"
    }  # fmt: skip
    assert info_document(log)["estimate"] == said


def test_a_run_that_has_lost_its_estimate_has_none_at_the_end(
    write: Write, driven: tuple[SimRun, list[Record]]
) -> None:
    time_ns = next(record.time_ns for record in driven[1] if isinstance(record, EventRecord))
    log = read_log(write(lambda records: records.append(EventRecord(time_ns, LOST, "not finite"))))
    assert (last_estimate(log), bool(by_step(log))) == ({}, True)


def test_a_run_that_ended_early_decides_and_estimates_the_same_again(write: Write, bench: Bench) -> None:
    result = again(write(), bench)
    assert result.differences == ()
    assert result.outcome is not None
    assert result.outcome.goal_reached


def test_an_estimate_that_is_other_in_its_last_bit_or_missing_or_of_no_sample_is_reported(
    write: Write, bench: Bench
) -> None:
    def change(records: list[Record]) -> None:
        record = records[estimates(records)[50]]
        assert isinstance(record, EstimateRecord)
        numbers = (*record.numbers[:7], float(np.nextafter(record.numbers[7], 1.0)))
        records[estimates(records)[50]] = record._replace(numbers=numbers)

    def remove(records: list[Record]) -> None:
        del records[estimates(records)[50]]

    def add(records: list[Record]) -> None:
        record = records[estimates(records)[50]]
        assert isinstance(record, EstimateRecord)
        records.append(record._replace(step=STEPS))

    assert [(d.step, d.what) for d in again(write(add), bench).differences] == [(STEPS, "estimate")]
    for alter in (change, remove):
        assert [(d.step, d.what) for d in again(write(alter), bench).differences] == [(50, "estimate")]


def test_a_goal_that_nothing_estimates_is_refused_in_one_line(write: Write, replay: Replay) -> None:
    err = replay.refused("rerun", write(stop_when="J=1%"), code=6)
    assert "emb.run: stop_when: --stop-when: " in err
    assert err.count("\n") == 1


def test_without_its_goal_the_run_goes_another_way(write: Write) -> None:
    result = rerun(read_log(write()), ACTOR, 6.0)
    assert not result.reproduced


def test_a_topic_with_other_fields_is_refused_in_one_line(write: Write) -> None:
    readers: tuple[Callable[[RunLog], object], ...] = (by_step, last_estimate, info_document)
    for change in (without("/estimate", "T_c"), with_field("/estimate", "T_c", "string")):
        path = write()
        rewritten(path, change, values=lambda _t, _n, row: {**row, "T_c": "1"} if "T_c" in row else row)
        for read in readers:
            with pytest.raises(LogError, match="/estimate have other fields: expected ") as caught:
                read(read_log(path))
            assert "\n" not in str(caught.value)


def test_a_log_without_estimates_has_no_such_topic(
    simulate: Simulate, bench: Bench, layout: Layout, tmp_path: Path
) -> None:
    journal = Journal()
    run = simulate(steps=20, journal=journal, on_bench=(closed := replace(bench, prior="nominal")))
    log = read_log(write_trace(tmp_path / "run.mcap", journal.records, closed, layout, run.outcome, steps=20))
    assert "/estimate" not in log.topics
    assert (by_step(log), last_estimate(log)) == ({}, {})
    assert "estimate" not in info_document(log)
