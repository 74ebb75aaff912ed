"""The checker of the learning shield's argument: it accepts the laws of parts, and refuses broken ones."""

from __future__ import annotations

import inspect
from dataclasses import replace
from types import ModuleType
from typing import Any

import pytest

import tools.proof.cases as cases_module
import tools.proof.learning.parts as parts_module
from emb_runtime.config.bench import load_bench
from emb_runtime.learning import bounded
from tools.proof.cases import Case, case_of
from tools.proof.lemmas import LEARNING, judge

SHIPPED = case_of(load_bench())
LEMMAS = {lemma.key: lemma for lemma in LEARNING}
SLOW = ("M3d", "M3f", "M3g")  # Minutes of solver: `make proof` checks them


def refused(key: str, case: Case = SHIPPED) -> str:
    """Why a lemma is not proved; empty if it is."""
    return judge(LEMMAS[key], case).reason


def law_with(**changed: Any) -> Case:
    return SHIPPED._replace(law=SHIPPED.law._replace(**changed))


def declared(**keys: Any) -> Case:
    return case_of(replace(SHIPPED.bench, shield=SHIPPED.bench.shield._replace(learn=True, **keys)))


@pytest.mark.parametrize("key", [key for key in LEMMAS if key not in SLOW])
def test_the_laws_of_parts_have_their_lemmas(key: str) -> None:
    assert refused(key) == ""


@pytest.mark.parametrize("key", ["M1a", "M1b", "M2", "M3a", "M3b", pytest.param("M3c", marks=pytest.mark.slow)])
def test_so_have_those_of_a_bench_that_declares_a_model_error(key: str) -> None:
    assert refused(key, declared(model_error=700.0)) == ""


BROKEN_LAWS: list[tuple[str, str, Case]] = [
    ("M2", "friction beside a weak motor", law_with(motor_low=0.05 * SHIPPED.law.motor_low)),
    ("M3b", "a sample in which viscous friction changes by more than the pad", law_with(viscous_high=12.0)),
    ("M3d", "margin too small", law_with(top=SHIPPED.law.top + 0.2, bottom=SHIPPED.law.bottom - 0.2)),
    ("M3e", "damping that reverses", law_with(damping_velocity=30.0)),
    ("M3e", "spring stronger than braking", law_with(spring_high=1.2 * SHIPPED.law.spring_high)),
]


@pytest.mark.parametrize(("key", "what", "case"), BROKEN_LAWS, ids=[f"{k}: {w}" for k, w, _ in BROKEN_LAWS])
def test_a_set_whose_parts_are_not_safe_is_refused(key: str, what: str, case: Case) -> None:
    assert "broken" in refused(key, case), what


def test_a_part_that_counts_on_all_of_its_viscous_friction_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts_module, "COVERED", 1.2)
    monkeypatch.setattr(cases_module, "COVERED", 1.2)
    assert "growth: broken" in refused("M3b")


def test_the_pad_on_the_way_home_is_needed_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts_module, "EXACT", 1.02)
    assert "growth: broken" in refused("M3b")


def test_a_part_without_the_pad_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tools.proof.successors.VELOCITY_PAD", 0.0)
    assert "broken" in refused("M3b")


def test_a_law_that_is_stronger_than_its_part_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = cases_module.law_within

    def boastful(facts: Any, case: Case, outer: Any, one: bool) -> Any:
        law = plain(facts, case, outer, one)
        return law if one else law._replace(braking=1.01 * law.braking)

    monkeypatch.setattr(parts_module, "law_within", boastful)
    assert "above: broken" in refused("M1b")


def test_a_safe_set_without_the_way_of_the_last_slow_samples_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = cases_module.reserve

    def less(law: Any, braking: Any, v: Any) -> Any:
        return plain(law, braking, v) - 0.5 * law.sample_time * v

    monkeypatch.setattr("tools.proof.safety.reserve", less)
    assert "damped stop down: broken" in refused("M3f")


BROKEN_FUNCTIONS = [
    ("B2", bounded, "_rise", "2.0 * assumptions.velocity_noise", "1.9 * assumptions.velocity_noise"),
    ("B2", bounded, "_rise", "pad += nt * _unmodelled(assumptions, state)", ""),
    ("B2", bounded, "_bend", "4.0 * assumptions.angle_noise / nt", "3.5 * assumptions.angle_noise / nt"),
    ("B2", bounded, "_bend", "- 2.0 * state[b + 5]", "- 1.9 * state[b + 5]"),
    ("B2", bounded, "_unmodelled", "+ assumptions.model_error", ""),
    ("B2", bounded, "_unmodelled", "* assumptions.current_error", "* 0.0"),
    ("B2", bounded, "_record", "t * max(before, 0.0)", "t * max(angle, 0.0)"),
    ("B4", bounded, "_cut_ellipsoid", "nn * taken", "nn * m"),
    ("B4", bounded, "_cut_ellipsoid", "taken / square", "0.9 * taken / square"),
]


@pytest.mark.parametrize(("key", "module", "name", "old", "new"), BROKEN_FUNCTIONS)
def test_a_learner_with_a_wrong_line_is_refused(
    key: str, module: ModuleType, name: str, old: str, new: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = inspect.getsource(getattr(module, name))
    assert source.count(old) == 1
    found: dict[str, Any] = {}
    exec(compile("from __future__ import annotations\n" + source.replace(old, new), name, "exec"), vars(module), found)
    monkeypatch.setattr(module, name, found[name])
    assert "broken" in refused(key)
