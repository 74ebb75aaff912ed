"""Sentences on a model that does not fit: the cause is named as one only where nothing is left to explain."""

from __future__ import annotations

from dataclasses import replace

import pytest

from emb_bench.config.bench import Bench
from emb_bench.report.sentences import alarms, left_by

from tests.bench.measurements import currents_of, fit, record  # isort: skip


@pytest.mark.parametrize(
    ("plant", "text", "said"),
    [
        ("stribeck", "square:period=0.2", "a static friction beyond T_c of about 20 % explains it (24 sigma)"),
        ("late", "chirp", "a delay of the commands of about 1 samples explains 99 % of it (31 sigma)"),
    ],
)
def test_an_effect_explains_a_misfit_only_where_none_is_left(bench: Bench, plant: str, text: str, said: str) -> None:
    e = fit(bench, "exact", [record(bench, bench.plant(plant), currents_of(bench, text))])
    assert alarms(e)[0].startswith(said)
    assert (left_by(e.validation.suspects[0], e.validation) > e.validation.expected[1]) is ("% of it" in said)


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


def test_one_term_of_a_curve_that_explains_it_alone_is_named_with_its_amount(bench: Bench) -> None:
    exact = bench.plant("exact")
    curved = replace(exact, mechanics=exact.mechanics._replace(quadratic=0.0005))
    said = alarms(fit(bench, exact, [record(bench, curved, currents_of(bench, "chirp"))]))[0]
    assert said.startswith("a quadratic stiffness of about 0.00048 1/rad explains it (28 sigma)")
