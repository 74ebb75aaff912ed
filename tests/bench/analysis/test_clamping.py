"""Clamping force, holding current and friction band of an estimate, beside draws from its covariance."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from emb_bench import api
from emb_bench.analysis.clamping import clamping
from emb_bench.analysis.study import Study

from tests.bench.conftest import Replay  # isort: skip
from tests.bench.report_pages import make  # isort: skip

SMALL = 0.01  # Draws are smaller than the errors by this: to first order they are the same


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("clamping") / "run.mcap"
    api.simulate(made, plant="cubic", k_1=20.0, seed=3)
    return made


@pytest.fixture(scope="module")
def study(path: Path) -> Study:
    return api.estimate(path, nuisance="quadratic,cubic", starts=1)


def test_the_totals_are_those_of_draws_from_the_covariance_and_of_the_angle_s_scale(study: Study) -> None:
    e, rng, angle = study.estimate, np.random.default_rng(1), 40.0
    names = [u.name for u in e.unknowns]
    own = next(one for one in e.validation.budget if one.name == "angle_scale")
    scale = SMALL * own.size * rng.standard_normal(400_000)  # which moves the unknowns by ``bias``
    rest = e.covariance() - np.outer(own.bias, own.bias)
    moved = SMALL * rng.multivariate_normal(np.zeros(len(names)), rest, len(scale))
    moved += np.outer(scale / own.size, own.bias)
    at = dict(zip(names, (e.values + moved * e.scale).T, strict=True))
    x, gamma, m = angle / (1.0 + scale), e.bench.brake.gamma, e.plant.mechanics
    force = at["k_1"] * x * (1.0 + at["quadratic"] * x + at["cubic"] * x**2)
    drawn = {
        "force": force,
        "current": gamma * force / at["k_m"] - at["current_offset"],
        "friction": (m.break_away * at["T_c"] + m.f_l * force) / gamma,
    }
    found = clamping(e, angle)
    assert found is not None
    for name, values in drawn.items():
        one = getattr(found, name)
        assert one.value == pytest.approx(float(values.mean()), rel=1e-3)
        assert SMALL * one.total == pytest.approx(1.96 * float(values.std()), rel=0.02), name
    assert found.current.total / found.current.value < 0.1 * found.force.total / found.force.value, "J is in the force"


def test_a_brake_is_told_at_the_largest_angle_that_it_clamped_to(study: Study) -> None:
    found, largest = study.clamping, float(study.estimate.experiments[0].samples[:, 0].max())
    assert found is not None
    assert 0.0 <= largest - found.angle < 1.1


def test_no_force_is_told_of_what_is_not_known(path: Path, tmp_path: Path) -> None:
    assert api.estimate(path, starts=1, model="exact").clamping is None, "the model does not fit"
    api.simulate(tmp_path / "nominal.mcap", plant="exact", seed=3)
    found = api.estimate(tmp_path / "nominal.mcap", starts=1, params="k_m,T_c,f_v")
    assert found.model_fits
    assert found.clamping is None, "k_1 is not estimated"


def test_text_document_and_page_tell_the_same(path: Path, study: Study, replay: Replay, tmp_path: Path) -> None:
    options = ("--nuisance", "quadratic,cubic", "--starts", "1")
    found = study.clamping
    assert found is not None
    said = " ".join(replay.text("estimate", path, *options).split())
    known = rf"clamping force known to 2(\.\d)? %: {found.force.value:.0f} ± \d+ N at {found.angle:.0f} rad, held by"
    assert re.search(known, said), said
    told = replay.document("estimate", path, *options)["clamping"]
    assert told["angle"] == found.angle
    assert told["force"] == {"value": found.force.value, "total": found.force.total, "unit": "N"}
    page = " ".join(make(tmp_path / "page.html", path, *options).reader.texts)
    assert f"Clamping force at {found.angle:.0f} rad from contact." in page
