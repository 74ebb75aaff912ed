from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_bench.analysis.drift import Earlier, drifts, read_last
from emb_bench.config.bench import Bench
from emb_bench.estimate.estimate import Estimate
from emb_bench.report.sentences import drift as sentence
from emb_bench.report.sentences import other_model
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError

from tests.bench.measurements import currents_of, fit, record  # isort: skip


@pytest.fixture(scope="module")
def now(bench: Bench) -> Estimate:
    plant = bench.plant("exact")
    return fit(bench, plant, [record(bench, plant, currents_of(bench, "chirp"))])


def entry(value: float, deviation: float | None, relative: bool = True) -> dict[str, Any]:
    return {"value": value, "deviation_between_runs": deviation, "deviation_relative": relative}


def earlier(e: Estimate, **shifts: float) -> Earlier:
    """The same estimate with some values shifted."""
    return msgspec.convert(document(e, **shifts), Earlier)


def document(e: Estimate, **shifts: float) -> dict[str, Any]:
    """The same estimate with some values so many standard deviations of the difference away."""
    rows = zip(e.labels, e.values.tolist(), e.between_runs().tolist(), strict=True)
    return {
        "model": "exact",
        "model_fits": True,
        "records": [{"name": "may.mcap"}],
        "parameters": {
            name: entry(value + shifts.get(name, 0.0) * 2.0**0.5 * deviation * value, deviation * value, False)
            for name, value, deviation in rows
        },
    }


def test_a_change_is_measured_in_deviations_of_the_difference(now: Estimate) -> None:
    found = {drift.name: drift for drift in drifts(now, earlier(now, k_m=14.0, T_c=-1.0))}
    assert list(found) == list(PARAMETER_NAMES)
    assert found["k_m"].sigmas == pytest.approx(-14.0, rel=1e-6)
    assert found["T_c"].sigmas == pytest.approx(1.0, rel=1e-6)
    assert [drift.drifted for drift in found.values()] == [True, False, False, False]
    change = now.values[0] / found["k_m"].last - 1.0
    assert found["k_m"].relative_change == pytest.approx(change)
    assert all(drift.since == ("may.mcap",) for drift in found.values())
    assert abs(found["T_c"].relative_change) < found["T_c"].detectable < 0.01
    assert found["k_m"].detectable < abs(found["k_m"].relative_change)
    assert drifts(now, earlier(now, k_m=-14.0))[0].sigmas == pytest.approx(14.0, rel=1e-6)


def test_where_nothing_has_changed_one_campaign_in_twenty_says_that_something_has(now: Estimate) -> None:
    """Four parameters at once: without Bonferroni's correction it would be one in five."""
    rng, campaigns = np.random.default_rng(0), 600
    false = 0
    for shifts in rng.standard_normal((campaigns, 4)).tolist():
        found = drifts(now, earlier(now, **dict(zip(PARAMETER_NAMES, shifts, strict=True))))
        false += any(drift.drifted for drift in found)
    assert 0.025 < false / campaigns < 0.075


def test_a_deviation_may_be_relative_and_what_was_not_told_cannot_be_compared(now: Estimate) -> None:
    last = {"parameters": {"k_m": entry(0.02, 0.01), "k_1": entry(23.0, None)}}
    found, untold = drifts(now, msgspec.convert(last, Earlier))
    assert [found.last, found.last_deviation] == pytest.approx([0.02, 2e-4])
    assert found.sigmas == pytest.approx((now.values[0] - 0.02) / math.hypot(2e-4, found.deviation))
    assert (untold.last_deviation, untold.sigmas, untold.drifted) == (math.inf, 0.0, False)
    assert untold.detectable == math.inf


def test_a_model_that_was_another_or_did_not_fit_may_be_what_has_changed(now: Estimate) -> None:
    last = msgspec.structs.replace(earlier(now, k_m=14.0), model="stribeck", model_fits=False)
    found = other_model(now, last)
    assert "did not fit" in found
    assert "stribeck" in found
    assert other_model(now, earlier(now, k_m=14.0)) == ""
    wrong = replace(now, validation=replace(now.validation, alarming=frozenset({"size"})))
    assert "does not fit" in other_model(wrong, earlier(now, k_m=40.0))


def test_only_what_both_have_is_compared(now: Estimate) -> None:
    last = document(now)
    del last["parameters"]["k_m"]
    last["parameters"]["J"] = entry(4.6e-6, 0.1)
    assert [drift.name for drift in drifts(now, msgspec.convert(last, Earlier))] == ["k_1", "T_c", "f_v"]
    with pytest.raises(UsageError, match="nothing to compare"):
        drifts(now, msgspec.convert({"parameters": {"J": entry(4.6e-6, 0.1)}}, Earlier))


def test_a_report_is_read_as_the_estimate_in_it(tmp_path: Path, now: Estimate) -> None:
    path = tmp_path / "report.json"
    for text in ({"estimate": document(now), "identity": {}}, document(now) | {"more": 1}):
        path.write_text(json.dumps(text))
        assert read_last(path) == earlier(now)


def test_a_file_that_is_no_estimate_is_refused_in_one_line(tmp_path: Path) -> None:
    def stated(value: str) -> str:
        return f'{{"parameters":{{"k_m":{{"value":{value},"deviation_between_runs":0.1,"deviation_relative":true}}}}}}'

    values = ('"0.02"', "null", "true", "NaN", "1e999", "1" + 400 * "0", "1" + 5000 * "0", "0")
    path = tmp_path / "last.json"
    for content in (
        *("", "[1, 2]", "{}", '{"parameters":{}}', '{"parameters":[1]}', '{"parameters":{"k_m":3}}'),
        *map(stated, values),
        '{"parameters":{"k_m":{"value":1,"deviation_between_runs":-1,"deviation_relative":true}}}',
        '{"parameters":{"k_m":{"value":1,"deviation_between_runs":1}}}',
        *("[" * 100_000, "\udcff", '{"parameters":{"k\\nm\\u001b[2J":3}}'),
    ):
        path.write_bytes(content.encode("utf-8", "surrogateescape"))
        with pytest.raises(UsageError) as refused:
            read_last(path)
        assert str(refused.value).startswith(f"--last {path}: ")
        assert str(refused.value).isprintable()
        assert len(str(refused.value)) < len(str(path)) + 200
    with pytest.raises(UsageError, match="No such file"):
        read_last(tmp_path / "none.json")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)
ENTRY = st.fixed_dictionaries(
    {}, optional=dict.fromkeys(("value", "deviation_between_runs", "deviation_relative"), JSON)
)
PARAMETERS = JSON | st.dictionaries(st.sampled_from(PARAMETER_NAMES), JSON | ENTRY, max_size=3)


@given(
    content=st.fixed_dictionaries(
        {"parameters": PARAMETERS}, optional={"records": JSON, "model": JSON, "model_fits": JSON}
    )
)
def test_whatever_stands_in_the_document_it_is_compared_or_refused(
    now: Estimate, content: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.json"
    path.write_text(json.dumps(content))
    try:
        found = drifts(now, read_last(path))
    except UsageError:
        return
    for drift in found:
        assert math.isfinite(drift.relative_change)
        assert math.isfinite(drift.sigmas)
        assert sentence(drift).isprintable()
