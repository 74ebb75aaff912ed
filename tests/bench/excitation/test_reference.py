"""Reference excitations: the signals are what their names say, and behind the shield they keep limits and come home."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.config.bench import Bench, load_bench
from emb_bench.excitation import (
    EXCITATIONS,
    Excitation,
    Response,
    excitation,
    parse_excitation,
    run_excitation,
    schroeder_phases,
)
from emb_bench.experiment.experiment import planned
from emb_bench.experiment.simulate import Theta
from emb_bench.experiment.simulate import simulate as simulate_brake
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.errors import UsageError
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.records import Reason
from tests.conftest import Simulate

BENCH = load_bench()
SEQUENCES = tuple(name for name in EXCITATIONS if name != "constant-speed")


def currents(name: str, bench: Bench = BENCH, **parameters: float) -> Floats:
    found = excitation(name, bench, **parameters).currents
    assert found is not None
    return found


def played(
    excited: Excitation | str,
    plant: str = "euler",
    p: BrakeParameters = BENCH.brake,
    *,
    shielded: bool = False,
    noise: Floats | None = None,
) -> Response:
    """Response of a brake, without the shield unless said otherwise, to an excitation or the one of a name."""
    actor = excitation(excited, BENCH) if isinstance(excited, str) else excited
    return run_excitation(BENCH, actor, BENCH.plant(plant).mechanics, p, shielded=shielded, noise=noise)


def drawn(rng: np.random.Generator) -> tuple[BrakeParameters, Floats]:
    """A brake of the shield's set, and the sensors' noise of one experiment, as far out as the shield allows."""
    box = BENCH.range_set(BENCH.shield.ranges)
    deviations = [BENCH.noise.angle, BENCH.noise.velocity]
    errors = rng.standard_normal((BENCH.timing.horizon + 1, 2)) * deviations
    return BrakeParameters(*rng.uniform(box.low, box.high).tolist()), errors


# --- The signals ------------------------------------------------------------------------------------------------------


def test_a_sequence_has_one_current_within_the_limit_for_each_step_of_any_bench() -> None:
    other = replace(
        BENCH, timing=replace(BENCH.timing, sample_time=0.002, horizon=90), limits=replace(BENCH.limits, current=2.0)
    )
    for name, bench in itertools.product(SEQUENCES, (BENCH, other)):
        sequence = currents(name, bench)
        assert sequence.shape == (bench.timing.horizon,), name
        assert np.isfinite(sequence).all(), name
        assert np.abs(sequence).max() <= bench.limits.current, name
        assert excitation(name, bench).act(50.0, -300.0, 17.0, Estimator(bench)) == sequence[17], name


K = np.arange(500)
SIGNALS: dict[str, Any] = {
    "square": np.resize([6.0] * 10 + [-6.0] * 10, 500),  # the thesis's
    **{
        f"square:amplitude=2.5,period={period}": 2.5 * scipy.signal.square(2.0 * np.pi * (K + 1e-6) * 1e-3 / period)
        for period in (0.02, 0.03, 0.007, 0.1)
    },
    **{
        f"chirp:f0={f0},f1={f1}": 3.0 * scipy.signal.chirp(1e-3 * K, f0, 0.5, f1, phi=-90.0)
        for f0, f1 in ((1.0, 50.0), (80.0, 2.0), (10.0, 10.0))
    },
    "ramp:start=-1,amplitude=4": -1.0 + 0.01 * K,
    "step:amplitude=-2,at=0.1": np.repeat([0.0, -2.0], [100, 400]),
}


@pytest.mark.parametrize("text", SIGNALS)
def test_a_signal_is_that_of_its_name_beside_scipy_s(text: str) -> None:
    assert parse_excitation(text, BENCH).currents == pytest.approx(SIGNALS[text], rel=0.0, abs=1e-9)


def bits_of(order: int, seed: int) -> Floats:
    """One period of a binary sequence, as zeros and ones."""
    long = replace(BENCH, timing=replace(BENCH.timing, horizon=2**order - 1))
    return currents("prbs", long, order=order, seed=seed, hold=1e-3, amplitude=0.5) + 0.5


def test_another_seed_is_another_point_of_the_same_cycle() -> None:
    cycle = "".join(str(int(bit)) for bit in bits_of(6, 1)) * 2
    starts = [cycle.index("".join(str(int(bit)) for bit in bits_of(6, seed))) for seed in range(1, 64)]
    assert sorted(starts) == list(range(63))


def test_a_prbs_holds_each_bit_and_repeats() -> None:
    sequence = currents("prbs", order=4, hold=0.005, amplitude=2.0)
    assert np.array_equal(sequence, np.repeat(np.resize(4.0 * bits_of(4, 1) - 2.0, 100), 5))


def test_a_multisine_has_equal_lines_and_nothing_between_them() -> None:
    lines = np.abs(np.fft.rfft(currents("multisine", f0=4.0, f1=100.0)))  # of 2 Hz
    wanted = np.zeros(len(lines))
    wanted[2:51:2] = lines[2]
    assert lines == pytest.approx(wanted, abs=1e-9 * lines[2])
    assert lines[2] > 1.0
    assert np.abs(currents("multisine", amplitude=-4.5)).max() == pytest.approx(4.5, rel=1e-12)  # its peak


@pytest.mark.parametrize("count", [5, 12, 25, 60])
def test_schroeder_s_phases_give_a_low_crest_factor(count: int) -> None:
    def crest(phases: Floats) -> float:
        t = np.linspace(0.0, 2.0 * np.pi, 40 * count, endpoint=False)
        signal = np.cos(np.outer(t, np.arange(1, count + 1)) + phases).sum(axis=1)
        return float(np.abs(signal).max() / np.sqrt(np.mean(signal**2)))

    rng = np.random.default_rng(count)
    random = [crest(rng.uniform(0.0, 2.0 * np.pi, count)) for _ in range(30)]
    found = crest(schroeder_phases(count))
    assert found < min(random)
    assert found < 1.9  # a single sine has 1.41, no phases at all sqrt(2 count)


def test_constant_speed_holds_the_speed_and_turns_when_told_to() -> None:
    excited = excitation("constant-speed", BENCH, speed=200.0, turn=0.2)
    assert excited.currents is None
    velocity = played(excited, "exact").states[:, 1]
    assert velocity[50:200] == pytest.approx(200.0, abs=1.0)
    assert velocity[260:] == pytest.approx(-200.0, abs=1.0)
    response = played("constant-speed")  # at the speed limit by default
    assert response.states[100:, 1] == pytest.approx(500.0, abs=0.5)
    assert not response.kept  # of the angle nobody has spoken


# --- Names, parameters, text ------------------------------------------------------------------------------------------


def test_the_text_of_an_excitation_reads_back_as_the_same() -> None:
    for name in EXCITATIONS:
        first = excitation(name, BENCH)
        again = parse_excitation(first.text, BENCH)
        assert (again.text, again.parameters) == (first.text, first.parameters)
        seen = 12.0, 340.0, 499.0, Estimator(BENCH)
        assert again.act(*seen) == first.act(*seen)


def test_a_wrong_text_is_refused() -> None:
    for text in (
        *("sine", "", "square:phase=1", "square:amplitude=big", "square:amplitude=6.1", "square:amplitude=nan"),
        *("square:period=0.001", "square:period", "square:period=1,period=2", "chirp:f1=501", "chirp:f0=-1"),
        *("prbs:order=17", "prbs:order=2.5", "prbs:seed=64", "multisine:f0=60", "constant-speed:speed=501"),
        *("step:at=-1", "step:at=inf"),
    ):
        with pytest.raises(UsageError):
            parse_excitation(text, BENCH)


# --- Against a brake --------------------------------------------------------------------------------------------------


@given(data=st.data())
@settings(max_examples=100, deadline=None)
def test_behind_the_shield_every_brake_keeps_its_limits_and_comes_home_whatever_excites_it(data: st.DataObject) -> None:
    share = st.floats(-1.0, 1.0)
    amplitude = share.map(lambda s: 6.0 * s)
    frequency = st.floats(0.5, 400.0)
    choices: dict[str, dict[str, Any]] = {
        "constant-speed": {"speed": share.map(lambda s: 500.0 * s), "turn": st.floats(0.0, 0.6)},
        "square": {"amplitude": amplitude, "period": st.floats(0.002, 0.6)},
        "chirp": {"amplitude": amplitude, "f0": frequency, "f1": frequency},
        "prbs": {"amplitude": amplitude, "hold": st.floats(0.001, 0.1), "seed": st.integers(1, 63)},
        "multisine": {
            "amplitude": amplitude,
            "f0": st.floats(2.0, 20.0),
            "f1": st.floats(20.0, 400.0),
        },
        "ramp": {"amplitude": amplitude, "start": amplitude},
        "step": {"amplitude": amplitude, "at": st.floats(0.0, 0.5)},
    }
    name = data.draw(st.sampled_from(sorted(choices)))
    excited = excitation(name, BENCH, **data.draw(st.fixed_dictionaries(choices[name])))
    p, errors = drawn(np.random.default_rng(data.draw(st.integers(0, 2**32 - 1))))
    response = played(excited, data.draw(st.sampled_from(["euler", "exact"])), p, shielded=True, noise=errors)
    assert response.kept
    assert response.home
    assert np.abs(response.currents).max() <= BENCH.limits.current
    assert response.reasons[-1] & Reason.RETURNING


def test_without_the_shield_the_same_excitations_leave_the_limits() -> None:
    rng = np.random.default_rng(5)
    left = set()
    for name in EXCITATIONS:
        for _ in range(4):
            p, errors = drawn(rng)
            response = played(name, "euler", p, noise=errors)
            assert not response.reasons.any()
            left |= set() if response.kept else {name}
    assert {"constant-speed", "ramp"} <= left


@pytest.mark.parametrize("plant", ["euler", "exact"])
def test_without_the_shield_a_sequence_acts_as_it_is(plant: str) -> None:
    response = played("multisine", plant)
    assert np.array_equal(response.currents, currents("multisine"))
    acted = planned(response.currents)
    expected = simulate_brake(BENCH.plant(plant), Theta(BENCH.brake), acted, 1e-3).states
    assert np.array_equal(response.states, expected)


def test_an_actor_that_asks_for_too_much_is_clipped() -> None:
    greedy = Excitation("greedy", {}, lambda _angle, _velocity, _k: 50.0, None)
    response = played(greedy)
    assert (response.currents == BENCH.limits.current).all()
    assert (response.wanted == 50.0).all()


@pytest.mark.parametrize(("periods", "kept"), [(20, True), (30, False)])
def test_too_much_speed_alone_breaks_a_limit(periods: int, kept: bool) -> None:
    hasty = Excitation("hasty", {}, lambda _x, v, k: 6.0 if k < periods else -0.01 * v, None)
    response = played(hasty, "exact")
    assert -10.0 < response.states[:, 0].min() <= response.states[:, 0].max() < 100.0
    assert response.kept == kept


@pytest.mark.parametrize("name", ["constant-speed", "prbs", "square"])
def test_the_runtime_takes_an_excitation_as_its_actor(simulate: Simulate, name: str) -> None:
    excited = excitation(name, BENCH)
    run = simulate(actor=excited, options="seed=4,f_v=3e-5")
    assert run.outcome.fault is None
    assert run.outcome.home
    node = run.transport.node
    low, high = BENCH.limits.angle
    assert low <= node.angle_range[0] <= node.angle_range[1] <= high
    assert node.top_speed <= BENCH.limits.velocity
    if excited.currents is not None:
        asked = {cycle.step: cycle.policy_current for cycle in run.journal.cycles if 0 <= cycle.step < 500}
        assert [asked[k] for k in range(500)] == excited.currents.tolist()
