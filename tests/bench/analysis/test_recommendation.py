from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from emb_bench.analysis.recommendation import HELPS, PRECISE, advise
from emb_bench.brake.motion import Floats
from emb_bench.config.bench import Bench
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.records import EstimationProblem
from emb_bench.excitation import parse_excitation, run_excitation
from emb_bench.experiment.experiment import Experiment
from emb_bench.information.fisher import fisher
from emb_runtime.config.bench import PARAMETER_NAMES

from tests.bench.measurements import currents_of, disturbed, fit, record  # isort: skip


def estimated(
    bench: Bench, records: Sequence[Experiment], *nuisances: str, params: tuple[str, ...] = PARAMETER_NAMES
) -> Estimate:
    return fit(bench, "exact", records, EstimationProblem(params, nuisances), starts=2)


NEVER_CLAMPS, STANDS = np.full(80, -0.8), np.full(80, 0.2)


@pytest.mark.parametrize("currents", [NEVER_CLAMPS, STANDS, np.full(80, 0.9)])
def test_the_first_advice_when_carried_out_tells_what_was_not_told(bench: Bench, currents: Floats) -> None:
    plant = bench.plant("exact")
    short = record(bench, plant, currents)
    e = estimated(bench, [short])
    assert not e.verdict().identified
    first = advise(e)[0]
    played = run_excitation(
        bench, parse_excitation(first.excitation, bench), plant.mechanics, bench.brake, shielded=True
    )
    joint = estimated(bench, [short, record(bench, plant, played.currents, seed=1)])
    assert joint.verdict().identified
    assert joint.validation.fits
    for name, value, deviation in zip(joint.labels, joint.values, joint.cramer_rao(), strict=True):
        assert abs(value / getattr(bench.brake, name) - 1.0) < 5.0 * deviation
        assert deviation < PRECISE


def test_what_is_promised_of_a_disturbed_brake_allows_for_the_disturbance(bench: Bench) -> None:
    plant, asked = bench.plant("exact"), EstimationProblem(("k_m", "f_v"))
    short = disturbed(bench, currents_of(bench, "chirp")[:150], bench.brake, 3)
    e = fit(bench, plant, [short], asked, method="pem")
    assert e.validation.fits
    first = advise(e)[0]
    assert list(first.before.values()) == pytest.approx(e.cramer_rao(), rel=1e-9)
    again = disturbed(bench, currents_of(bench, first.excitation), bench.brake, 4)
    both = fit(bench, plant, [short, again], asked, method="pem")
    assert list(first.after.values()) == pytest.approx(both.cramer_rao(), rel=0.2)
    still = advise(replace(e, process_noise=0.0))
    assert min(one.after["f_v"] for one in still) < 0.5 * first.after["f_v"]


def test_information_adds_up(bench: Bench) -> None:
    """The other implementation of the Fisher information, at the estimate."""
    plant, params = bench.plant("exact"), ("k_m", "k_1")
    e = estimated(bench, [record(bench, plant, NEVER_CLAMPS)], params=params)
    inside = e.theta
    for one in advise(e):
        played = run_excitation(bench, parse_excitation(one.excitation, bench), plant.mechanics, inside, shielded=True)
        more = fisher(bench, inside, played.currents, kind="physical", plant=plant, params=params).matrix
        expected = np.sqrt(np.diag(np.linalg.inv(e.information + more)))
        assert list(one.after.values()) == pytest.approx(expected, rel=1e-3)


def test_advice_comes_best_first_and_of_different_kinds(bench: Bench) -> None:
    found = advise(estimated(bench, [record(bench, bench.plant("exact"), NEVER_CLAMPS)]))
    worst = [max(one.after[name] for name in one.wanting) for one in found]
    assert worst == sorted(worst)
    assert len({one.excitation.partition(":")[0] for one in found}) == len(found) == 3
    for one in found:
        assert one.before["k_1"] == np.inf
        assert one.after["k_1"] < HELPS
        assert one.direction == "+1 k_1"
        assert "k_1" in one.wanting


def test_nothing_is_advised_where_all_is_told_well(bench: Bench) -> None:
    assert advise(estimated(bench, [record(bench, bench.plant("exact"), currents_of(bench, "chirp"))])) == ()


def test_nothing_is_advised_where_no_excitation_helps(bench: Bench) -> None:
    """Torques and inertia scale together in every experiment."""
    data = record(bench, bench.plant("exact"), currents_of(bench, "chirp"))
    assert advise(estimated(bench, [data], "J")) == ()


def test_what_each_run_has_anew_costs_information_in_the_next_one_too(bench: Bench) -> None:
    data = record(bench, bench.plant("exact"), NEVER_CLAMPS)
    known, unknown = advise(estimated(bench, [data])), advise(estimated(bench, [data], "offset", "x2_0"))
    plain = {one.excitation: one.after["k_1"] for one in known}
    common = [one for one in unknown if one.excitation in plain]
    assert common
    for one in common:
        assert list(one.after) == list(PARAMETER_NAMES)
        assert one.after["k_1"] > plain[one.excitation]
