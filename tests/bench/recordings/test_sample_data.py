"""The sample data in ``examples/`` say what was simulated, and are small."""

from __future__ import annotations

from typing import Any

import pytest

from emb_bench import api
from examples.recording import TRUTH

from tests.drives import EXAMPLES  # isort: skip

FOLDER = EXAMPLES.parent
WORN = {"k_m": 0.0217, "k_1": 23.04, "T_c": 0.01037, "f_v": 4e-5}
RECORDED = {"k_m": TRUTH.k_m, "k_1": TRUTH.k_1, "T_c": TRUTH.t_c, "f_v": TRUTH.f_v}


@pytest.mark.parametrize(
    ("name", "options", "truth", "most"),
    [("worn.mcap", {"starts": 1}, WORN, 300e3), ("recording.csv", {"map": FOLDER / "map.toml"}, RECORDED, 150e3)],
)
def test_the_values_lie_within_their_totals(
    name: str, options: dict[str, Any], truth: dict[str, float], most: float
) -> None:
    assert (FOLDER / name).stat().st_size < most
    study = api.estimate(FOLDER / name, **options)
    assert study.model_fits
    assert {*study.params} == {*truth}
    assert all(c.interval[0] <= truth[c.label] <= c.interval[1] for c in study)
