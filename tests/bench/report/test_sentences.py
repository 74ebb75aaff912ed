"""Sentences on a model that does not fit: the cause is named as one only where nothing is left to explain."""

from __future__ import annotations

from dataclasses import replace

import pytest

from emb_bench.config.bench import Bench
from emb_bench.estimate.records import Cause, Suspect
from emb_bench.report.sentences import alarms, explained

from tests.bench.measurements import currents_of, fit, record  # isort: skip


@pytest.mark.parametrize(
    ("plant", "text", "said"),
    [
        ("stribeck", "square:period=0.2", "a static friction beyond T_c of about 20 % explains it (24 sigma)"),
        ("late", "chirp", "a delay of the commands explains 99 % of it (31 sigma)"),
    ],
)
def test_an_effect_explains_a_misfit_only_where_none_is_left(bench: Bench, plant: str, text: str, said: str) -> None:
    e = fit(bench, "exact", [record(bench, bench.plant(plant), currents_of(bench, text))])
    assert alarms(e)[0].startswith(said)
    m = e.validation
    assert m.cause is not None
    left = (m.chi2 - m.cause.suspect.fall) / (m.freedom - 1)
    assert (m.cause.share == 1.0) is (left <= m.expected[1]) is ("% of it" not in said)


@pytest.mark.parametrize("text", ["chirp", "square:period=0.2"])
@pytest.mark.parametrize(("quadratic", "cubic"), [(0.02, -0.0007), (0.01, -0.0004), (-0.02, 0.0007), (-0.012, 0.0003)])
def test_two_terms_of_a_curve_that_nearly_cancel_are_named_together(
    bench: Bench, quadratic: float, cubic: float, text: str
) -> None:
    """Alone each leaves a misfit, and another effect seems to explain more."""
    exact = bench.plant("exact")
    curved = replace(exact, mechanics=exact.mechanics._replace(quadratic=quadratic, cubic=cubic))
    said = alarms(fit(bench, exact, [record(bench, curved, currents_of(bench, text))]))[0]
    assert said.startswith("a stiffness with a quadratic and a cubic term explains ")
    assert "remedy: estimate it as well: --nuisance quadratic,cubic" in said


@pytest.mark.parametrize(
    ("quadratic", "said"),
    [
        (0.0005, "a quadratic stiffness of about 0.00048 1/rad explains it (28 sigma)"),
        (0.0001, "a quadratic stiffness is the most significant (10 sigma)"),
    ],
)
def test_one_term_of_a_curve_is_named_with_its_amount_if_it_explains_residuals_that_are_too_large(
    bench: Bench, quadratic: float, said: str
) -> None:
    """Residuals that are not too large leave no misfit to explain."""
    exact = bench.plant("exact")
    curved = replace(exact, mechanics=exact.mechanics._replace(quadratic=quadratic))
    e = fit(bench, exact, [record(bench, curved, currents_of(bench, "chirp"))])
    assert alarms(e)[0].startswith(said)
    assert ("size" in e.validation.alarming) is ("explains" in said)


@pytest.mark.parametrize(
    ("share", "is_curve", "said"),
    [
        (1.0, False, "a quadratic stiffness of about 0.002 1/rad explains it (9 sigma); remedy: "),
        (0.87, False, "a quadratic stiffness explains 87 % of it (9 sigma); remedy: "),
        (None, False, "a quadratic stiffness is the most significant (9 sigma); remedy: "),
        (1.0, True, "a stiffness with a quadratic and a cubic term explains it (9 sigma); remedy: "),
    ],
)
def test_a_cause_is_worded_with_its_amount_if_it_explains_a_misfit(
    share: float | None, is_curve: bool, said: str
) -> None:
    cause = Cause(Suspect("quadratic", 0.002, 9.0), 9.0, share, is_curve, possible=True)
    assert explained(cause).startswith(said)
