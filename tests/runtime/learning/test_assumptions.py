"""Prior knowledge is the bench's, number by number; a bench that does not grant an assumption is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from emb_runtime.config.bench import Bench, BrakeParameters, Limits, Noise, Ranges, Timing, load_bench
from emb_runtime.errors import BenchFileError
from emb_runtime.learning.assumptions import Assumptions, assumptions_of, make_assumptions, unmet_assumption
from emb_runtime.safety.shield_design import make_law

BENCH = load_bench()


def with_shield(bench: Bench = BENCH, **change: Any) -> Bench:
    return replace(bench, shield=bench.shield._replace(**change))


def test_each_number_is_the_benchs() -> None:
    nominal = BrakeParameters(J=2.0, gamma=0.5, k_m=4.0, k_1=8.0, T_c=3.0, f_v=5.0)
    low = BrakeParameters(J=2.0, gamma=0.5, k_m=1.0, k_1=4.0, T_c=0.3, f_v=4.0)
    high = BrakeParameters(J=2.0, gamma=0.5, k_m=6.0, k_1=10.0, T_c=9.0, f_v=20.0)
    bench = replace(
        BENCH,
        brake=nominal,
        ranges={"drawn": Ranges("drawn", low, high)},
        limits=Limits(current=5.5, angle=(-9.0, 90.0), velocity=444.0),
        noise=Noise(angle=0.002, velocity=0.7),
        timing=Timing(sample_time=0.002, horizon=321),
    )
    shield = {"ranges": "drawn", "model_error": 12.0, "current_error": 0.03, "noise_sigmas": 4.0}
    expected = Assumptions(
        sample_time=0.002,
        flow=True,
        motor=2.0,
        spring=2.0,
        coulomb=1.5,
        viscous=2.5,
        low=(0.25, 0.5, 0.1, 0.8),
        high=(1.5, 1.25, 3.0, 4.0),
        current=5.5,
        speed=444.0,
        model_error=12.0,
        current_error=0.03,
        angle_noise=0.008,
        velocity_noise=2.8,
    )
    found = assumptions_of(with_shield(bench, **shield))
    for name, value in expected._asdict().items():
        assert getattr(found, name) == pytest.approx(value, rel=1e-12), name
    assert not assumptions_of(with_shield(bench, **shield, model="euler")).flow


def test_the_shipped_bench_grants_everything() -> None:
    bench = with_shield(learn=True)
    assert unmet_assumption(bench) == ""
    assert make_assumptions(bench) == assumptions_of(bench)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"envelope": "coasting", "angle_margin": 1.1}, "coasts"),
        ({"frame_age": (0, 1)}, "late frames"),
        ({"current_lag": 5e-4}, "lags"),
        ({"break_away": 1.05}, "model_error"),
        ({"f_l": 1e-6}, "model_error"),
    ],
)
def test_a_bench_that_does_not_grant_an_assumption_is_refused(change: dict[str, Any], said: str) -> None:
    with pytest.raises(BenchFileError, match=said):
        make_assumptions(with_shield(**change))


def in_binary(model_error: float = 0.0, **change: tuple[float, float]) -> Bench:
    """A bench whose law is exact in floats: every number is one of few binary digits."""
    inertia = 2.0**-18
    ends = {"k_m": (2.0**-6, 2.0**-5), "k_1": (24.0, 70.0), "T_c": (1536.0 * inertia,) * 2, "f_v": (1e-5, 2e-5)}
    low, high = (
        BrakeParameters(J=inertia, gamma=2.0**-16, **{name: pair[i] for name, pair in (ends | change).items()})
        for i in (0, 1)
    )
    bench = replace(
        BENCH,
        ranges={"envelope": Ranges("envelope", low, high)},
        limits=replace(BENCH.limits, angle=(-10.0, 64.0)),
        timing=replace(BENCH.timing, sample_time=2.0**-10),
    )
    return with_shield(bench, learn=True, model_error=model_error, current_error=0.0)


@pytest.mark.parametrize("model_error", [0.0, 512.0])
def test_friction_of_half_of_what_the_weakest_motor_has_is_the_most(model_error: float) -> None:
    """6 A at k_m/J = 4096 are 24,576 rad/s²; what the model lacks may weaken friction, so that there may be more."""
    for share, accepted in ((1.0, True), (1.0 + 1e-6, False), (1.04, False)):
        friction = (12288.0 * share + model_error) * 2.0**-18
        bench = in_binary(model_error, T_c=(friction, friction))
        assert make_law(bench)
        if accepted:
            assert make_assumptions(bench)
        else:
            with pytest.raises(BenchFileError, match="half of what the weakest motor"):
                make_assumptions(bench)


@pytest.mark.parametrize("model_error", [0.0, 512.0])
def test_a_change_of_viscous_friction_by_all_that_the_pad_leaves_on_the_way_home_is_the_most(
    model_error: float,
) -> None:
    """t²/2 f_v/J (8192 · 6 A + 280 · 64 rad − friction) is 0.996 of the pad of 0.3 rad/s, to the last bit."""
    friction = (1536.0 - model_error) * 2.0**-18
    most = 0.996 * 0.3 * 2.0 ** (21 - 18 - 16)
    assert make_assumptions(in_binary(model_error, T_c=(friction, friction), f_v=(1e-5, most)))
    with pytest.raises(BenchFileError, match=r"changes by 0\.299 rad/s and 0\.2988 are"):
        make_assumptions(in_binary(model_error, T_c=(friction, friction), f_v=(1e-5, most * (1.0 + 1e-6))))
