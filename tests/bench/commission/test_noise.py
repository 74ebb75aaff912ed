"""Noise of samples that a drive tells in coarse steps."""

from __future__ import annotations

import numpy as np
import pytest

from emb_bench.commission.examination import noise_in_motion, scatter
from emb_runtime.config.bench import Noise
from emb_runtime.drives.mapping_file import load_mapping
from tests.drives import EXAMPLES


@pytest.mark.parametrize(
    ("sigma", "centre"), [(0.3, 0.0), (0.5, 0.0), (0.5, 0.5), (0.8, 0.25), (1.5, 0.5), (1.5, 0.0), (50.0, 0.0)]
)
def test_noise_of_less_than_a_step_is_found_wherever_the_brake_rests(sigma: float, centre: float) -> None:
    step, drawn = 3.4e-3, np.random.default_rng(4).normal(centre, sigma, 4000)
    for between in (0.0, 0.5):  # zero is one of the values, or lies between two
        assert scatter(step * (np.round(drawn) + between), step) == pytest.approx(sigma * step, rel=0.1)


def test_a_brake_that_shows_one_value_has_little_noise() -> None:
    assert scatter(np.full(500, 1.7e-3), 3.4e-3) < 1e-3


def test_a_signal_without_steps_scatters_as_its_samples_do() -> None:
    drawn = np.random.default_rng(4).normal(0.0, 1e-3, 500)
    assert scatter(drawn, 0.0) == pytest.approx(np.std(drawn, ddof=1), rel=1e-12)


def test_steps_add_to_the_noise_of_a_brake_that_moves_and_our_own_node_has_none_to_speak_of() -> None:
    at_rest = Noise(8e-4, 0.6)
    moving = noise_in_motion(at_rest, load_mapping(EXAMPLES / "mit.toml"))
    turned = np.random.default_rng(4).uniform(0.0, 10.0, 20_000)
    step = 9 * 25.0 / 65535  # a gear of 9; the protocol's 16 bits from -12.5 to 12.5 rad
    shown = step * np.floor((turned + np.random.default_rng(5).normal(0.0, 8e-4, turned.shape)) / step)
    assert moving.angle == pytest.approx(np.std(shown - turned), rel=0.03)
    assert noise_in_motion(at_rest, None) == at_rest
