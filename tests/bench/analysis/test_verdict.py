"""The verdict on a study: of all that holds the most severe counts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from emb_bench.analysis.options import EstimateOptions
from emb_bench.analysis.records import Differing, HeldOut
from emb_bench.analysis.stages import make_study
from emb_bench.analysis.study import Code, Result, Study, Tone, verdict
from emb_bench.information.identifiability import Doubt
from emb_bench.logs.log import read_log
from emb_bench.report.estimate import study_text

from tests.bench.simulated_logs import square, write_log  # isort: skip
from tests.benches import SENSOR_BENCH  # isort: skip
from tests.conftest import Simulate  # isort: skip

Change = Callable[[Study], Study]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory, simulate: Simulate) -> Study:
    """Of a run that was good, and of a machine that is real by its log."""
    path = write_log(tmp_path_factory.mktemp("verdict") / "a.mcap", simulate(square, options="plant=exact,seed=5"))
    found = make_study(SENSOR_BENCH, [read_log(path)], EstimateOptions(starts=1, model="exact"))
    return with_log(found, metadata={"emb.run": {"iface": "can0"}, "emb.end": {"exit_reason": "DONE"}})


def with_run(study: Study, **changes: Any) -> Study:
    return replace(study, runs=(replace(study.runs[0], **changes),))


def with_log(study: Study, **changes: Any) -> Study:
    return with_run(study, log=replace(study.runs[0].log, **changes))


def with_checks(study: Study, **changes: Any) -> Study:
    return replace(study, checks=replace(study.checks, **changes))


def with_first(study: Study, **changes: Any) -> Study:
    first, *others = study.conclusions
    return replace(study, conclusions=(replace(first, **changes), *others))


def of_method(study: Study, name: str) -> Study:
    return replace(study, joint=replace(study.estimate, method=name))


def cut_short(study: Study) -> Study:
    x = study.runs[0].experiment
    assert x is not None
    return with_run(study, experiment=replace(x, quality=replace(x.quality, planned=x.periods + 1)))


def misfit(study: Study) -> Study:
    e = study.estimate
    return replace(study, joint=replace(e, validation=replace(e.validation, alarming=frozenset({"size"}))))


def unidentified(study: Study) -> Study:
    return with_first(study, finding=replace(study.conclusions[0].finding, doubts=(Doubt.TOO_WIDE,)))


STOP = {"emb.run": {"iface": "can0"}, "emb.end": {"exit_reason": "SENSOR_LOST"}}
WORSE: list[tuple[Change, Code, Tone]] = [
    (lambda s: s, Code.FITS, "good"),
    (lambda s: with_log(s, complete=False, missing="the end"), Code.FITS, "care"),
    (lambda s: with_first(s, outside=(0.0, 1.0)), Code.FITS, "bad"),
    (unidentified, Code.NOT_IDENTIFIED, "bad"),
    (lambda s: with_checks(s, held_out=(HeldOut("a", 9.0, 1, 0.0, False),)), Code.DOES_NOT_PREDICT, "bad"),
    (misfit, Code.DOES_NOT_FIT, "bad"),
    (lambda s: of_method(s, "rls"), Code.BIASED_METHOD, "bad"),
    (lambda s: with_checks(s, apart=(Differing("k_m", (1.0, 2.0), 0.0),)), Code.APART, "bad"),
    (lambda s: with_log(s, metadata=STOP), Code.STOPPED, "bad"),
    (cut_short, Code.ABORTED, "bad"),
]
"""Changes from the mildest to the most severe, with the verdict after each."""


def test_each_reason_that_is_added_counts_before_the_milder_ones(study: Study) -> None:
    for change, code, tone in WORSE:
        study = change(study)
        assert (verdict(study).code, verdict(study).tone) == (code, tone)


def test_acceptance_counts_before_the_model_and_a_stop_before_both(study: Study) -> None:
    expected: dict[Result, tuple[Code, Tone]] = {
        Result.PASS: (Code.ACCEPTED, "good"),
        Result.CANNOT_TELL: (Code.UNDECIDED, "care"),
        Result.FAIL: (Code.REJECTED, "bad"),
    }
    for result, (code, tone) in expected.items():
        assert verdict(study, result) == (code, tone, Code.FITS)
        assert verdict(misfit(study), result) == (code, tone, Code.DOES_NOT_FIT)
        assert verdict(with_log(study, metadata=STOP), result).code is Code.STOPPED


def test_of_runs_side_by_side_the_worst_counts_whatever_their_order(study: Study) -> None:
    outside, worse = with_first(study, outside=(0.0, 1.0)), misfit(study)
    rows: list[tuple[Study, Study, Code, Tone]] = [
        (study, outside, Code.FITS, "bad"),
        (outside, worse, Code.DOES_NOT_FIT, "bad"),
    ]
    for one, other, code, tone in rows:
        for order in ((one, other), (other, one)):
            runs = tuple(replace(own.runs[0], alone=own) for own in order)
            assert verdict(replace(study, runs=runs, joint=None))[:2] == (code, tone)


def test_no_effect_is_below_the_level_of_an_alarm_where_the_model_does_not_fit(study: Study) -> None:
    def hinted(study: Study) -> Study:
        e = study.estimate
        suspects = (replace(e.validation.suspects[0], sigmas=2.9, p_value=0.02, possible=True),)
        return replace(study, joint=replace(e, validation=replace(e.validation, suspects=suspects)))

    assert "below the level of an alarm" in study_text(hinted(study), verbose=True)
    assert "below the level of an alarm" not in study_text(hinted(misfit(study)), verbose=True)


def test_nothing_is_good_without_an_estimate_or_of_a_simulated_brake(study: Study) -> None:
    none = replace(with_run(study, why_not="no experiment"), joint=None, conclusions=())
    assert verdict(none) == (Code.NO_ESTIMATE, "care", Code.NO_ESTIMATE)
    simulated = with_log(study, metadata={"emb.run": {"iface": "sim"}, "emb.end": {"exit_reason": "DONE"}})
    assert verdict(simulated) == (Code.FITS, "care", Code.FITS)
    assert verdict(simulated, Result.PASS).tone == "care"
