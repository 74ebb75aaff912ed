"""Several runs of one brake: what they share does not tell them apart, and one false alarm hides nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from emb_bench.analysis import held_out
from emb_bench.analysis.drift import Earlier, Entry, drifts
from emb_bench.analysis.held_out import GROUPS, apart, leave_one_out
from emb_bench.analysis.several_runs import apart_by
from emb_bench.config.bench import Bench
from emb_bench.estimate.effects import with_systematic
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.records import NORMAL_95, EstimationProblem
from emb_runtime.config.bench import PARAMETER_NAMES

from tests.bench.measurements import currents_of, fit, record  # isort: skip


def test_effects_that_move_both_runs_alike_tell_them_apart_by_no_more_than_the_rest() -> None:
    for deviation, effects, other, expected in (
        (5.0, {}, {}, 5.0),
        (5.0, {"play": (3.0, 0.1)}, {"play": (3.0, 0.1)}, 4.0),
        (5.0, {"play": (3.0, 0.1)}, {"play": (6.0, 0.2)}, 4.0),  # less is known of its size, which is the same
        (5.0, {"play": (3.0, 0.1)}, {"play": (-3.0, 0.1)}, (16.0 + 36.0) ** 0.5),
        (5.0, {"play": (3.0, 0.1)}, {"play": (0.0, 0.0)}, 5.0),
        (5.0, {"play": (3.0, 0.1)}, {}, 5.0),
        (5.0, {"T_c_drift": (3.0, 0.1)}, {"T_c_drift": (3.0, 0.1)}, 5.0),  # another one in each run
        (5.0, {"play": (3.0, 0.1), "f_v_drift": (-4.0, 0.1)}, {"play": (3.0, 0.1), "f_v_drift": (-4.0, 0.1)}, 4.0),
        (np.inf, {"play": (3.0, 0.1)}, {"play": (3.0, 0.1)}, np.inf),
    ):
        assert apart_by(deviation, effects, other) == pytest.approx(expected), (effects, other)


def earlier(e: Estimate) -> Earlier:
    """An estimate as its JSON has it."""
    rows = zip(e.labels, e.values.tolist(), e.between_runs().tolist(), strict=True)
    found = {name: Entry(value, True, deviation, e.effects(i)) for i, (name, value, deviation) in enumerate(rows)}
    return Earlier({name: found[name] for name in PARAMETER_NAMES})


def test_a_drift_shows_below_what_an_effect_of_the_brake_leaves_open_in_each_run(bench: Bench) -> None:
    """Play leaves T_c open to 0.3 %, in two runs alike; without the effects a change by 0.2 % would be none."""
    plant, currents = bench.plant("exact"), currents_of(bench, "chirp")
    asked = with_systematic(EstimationProblem(), bench, plant)
    loose = replace(plant, mechanics=plant.mechanics._replace(play=0.05))
    first, same, rubbed = (
        fit(bench, plant, [record(bench, loose, currents, seed=seed, brake=brake)], asked)
        for seed, brake in enumerate((bench.brake, bench.brake, bench.brake._replace(T_c=1.002 * bench.brake.T_c)))
    )
    assert all(e.validation.fits for e in (first, same, rubbed))
    assert not any(drift.drifted for drift in drifts(same, earlier(first)))
    found = {drift.name: drift for drift in drifts(rubbed, earlier(first))}
    assert [name for name, drift in found.items() if drift.drifted] == ["T_c"]
    both = math.hypot(first.between_runs()[2], rubbed.between_runs()[2])
    assert found["T_c"].detectable < 0.002 < NORMAL_95 * both


def test_many_records_are_predicted_from_few_estimates(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    currents, refitted, refit = currents_of(bench, "chirp"), list[Sequence[int]](), held_out.refit

    def counted(e: Estimate, chosen: Sequence[int]) -> Estimate:
        refitted.append(chosen)
        return refit(e, chosen)

    monkeypatch.setattr(held_out, "refit", counted)
    e = fit(bench, "exact", [record(bench, bench.plant("exact"), currents, seed=seed) for seed in range(GROUPS + 2)])
    assert all(one.fits for one in leave_one_out(e))
    assert refitted == [[1, 2, 3, 5], [0, 2, 3, 4], [0, 1, 3, 4, 5], [0, 1, 2, 4, 5]]


def test_changed_brakes_are_named_though_one_log_raises_a_false_alarm(bench: Bench) -> None:
    """Four logs, the last two with another f_v; the first is too noisy to fit alone."""
    plant, currents = bench.plant("exact"), currents_of(bench, "chirp")
    asked = with_systematic(EstimationProblem(), bench, plant)
    changed = bench.brake._replace(f_v=1.01 * bench.brake.f_v)
    noisy = record(bench, plant, currents, seed=9, noise=1.5)
    others = [record(bench, plant, currents, seed=i, brake=changed if i > 1 else bench.brake) for i in range(4)]
    found = apart(fit(bench, plant, [noisy, *others], asked))
    assert [one.name for one in found] == ["f_v"]
    assert found[0].values == pytest.approx(
        [math.nan, *[bench.brake.f_v] * 2, *[changed.f_v] * 2], rel=2e-3, nan_ok=True
    )
    assert apart(fit(bench, plant, [noisy, others[0]], asked)) == ()
