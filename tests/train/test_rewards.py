"""The rewards, branch by branch, against numbers worked by hand, and against the matrices they are made of."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_bench.config.bench import load_bench
from emb_bench.information.symmetric import pack
from emb_runtime.errors import UsageError
from emb_train.closed_loop import Batch
from emb_train.rewards import (
    ONE_PARAMETER,
    Reward,
    Transition,
    Turn,
    adaptive_return,
    determinant_gain,
    determinant_step,
    hybrid_return,
    information_increment,
    log_determinant,
    log_smallest_eigenvalue,
    log_trace,
    penalised_increment,
    quintic,
    require_defined,
    squared_determinant_gain,
    trajectory_return,
    transition,
)
from studies.thesis.determinant import normalised

AT_HOME = Turn(np.zeros((1, 2)), np.zeros(1), np.zeros((1, 1)))


def step(
    before: Any = 1000.0,
    after: Any = 4000.0,
    x: tuple[float, float] = (50.0, 300.0),
    k: int = 100,
    violated: bool = False,
    turn: Turn = AT_HOME,
) -> Transition:
    """One step of one brake in an experiment of 500 steps of 1 ms; a number is an FIM of one parameter."""
    m0, m1 = (np.atleast_1d(np.asarray(m, np.float64))[None, :] for m in (before, after))
    return Transition(m0, m1, np.array([x]), np.array([k]), np.array([violated]), turn, 500, 1e-3)


def worth(reward: Reward, transition: Transition) -> float:
    (value,) = reward(transition)
    return float(value)


# From 64 rad at rest the quintic is 64 (1 − 10 s³ + 15 s⁴ − 6 s⁵): half way 32 rad, and −64 · 1.875 / T rad/s.
FROM_REST = Turn(np.array([[64.0, 0.0]]), np.zeros(1), np.array([[500.0]]))
BRANCHES: dict[Reward, list[tuple[Transition, float]]] = {
    information_increment: [(step(), 3000.0)],
    penalised_increment: [
        (step(violated=True), -4e4),
        (step(x=(78.0, 100.0)), 3000.0 - 200.0 * 9.0),
        (step(x=(75.0, 400.0)), 3000.0),
        (step(x=(-9.0, 499.0)), 3000.0),  # no penalty for the speed, none at the lower limit
    ],
    adaptive_return: [
        (step(k=450, violated=True), -1e7),
        # k/T = 0.8: q = 0.64; (10 · 77)² + 50² = 595400
        (step(x=(77.0, -50.0), k=400), 0.36 * 3000.0 - 200.0 * 4.0 - 0.1 * 0.64 * 595400.0),
        (step(x=(77.0, -50.0), k=300), 3000.0 - 200.0 * 4.0),
        (step(x=(2.0, -50.0), k=400), 0.36 * 3000.0 - 0.1 * 0.64 * (400.0 + 2500.0)),
        (step(x=(2.0, -50.0), k=300), 3000.0),
        (step(x=(1.0, 2.0), k=500), -0.1 * 104.0),  # at the end the information is worth nothing
    ],
    trajectory_return: [
        (step(k=450, violated=True, turn=FROM_REST), -1e7),
        (step(x=(80.0, 0.0), k=300), 3000.0 - 200.0 * 25.0),
        (step(x=(32.0, -600.0), k=400, turn=FROM_REST), 0.0),  # on the quintic of 200 ms information earns nothing
        (step(x=(35.0, -590.0), k=400, turn=FROM_REST), -10.0 * 9.0 - 0.1 * 100.0),
        (step(x=(85.0, -600.0), k=400, turn=FROM_REST), -10.0 * 53.0**2),  # not risky any more, only off the way
        (step(x=(1.0, -10.0), k=500, turn=FROM_REST), -10.0 * 1.0 - 0.1 * 100.0 + 3500.0),
        (step(x=(2.1, 0.0), k=500, turn=FROM_REST), -10.0 * 2.1**2),  # not home
        (step(x=(0.0, 20.1), k=500, turn=FROM_REST), -0.1 * 20.1**2),
        (step(x=(0.0, 0.0), k=499, turn=FROM_REST._replace(x=np.zeros((1, 2)))), 0.0),  # home, but not at the end
    ],
    hybrid_return: [
        (step(k=480, violated=True, turn=FROM_REST), -1e7),
        (step(x=(80.0, 0.0), k=300), 3000.0 - 200.0 * 25.0),
        (step(x=(32.0, -800.0), k=375, turn=FROM_REST), 0.0),  # this quintic has 150 ms
        (step(x=(34.0, -800.0), k=375, turn=FROM_REST), -10.0 * 4.0),
        # s = 20/50: s² = 0.16
        (step(x=(3.0, -30.0), k=470, turn=FROM_REST), -10.0 * 0.84 * 9.0 - 0.1 * 0.16 * 900.0),
        (step(x=(1.0, -10.0), k=500, turn=FROM_REST), -0.1 * 100.0 + 0.1 * 3500.0),
        (step(x=(3.0, -10.0), k=500, turn=FROM_REST), -0.1 * 100.0),
    ],
}


def test_every_branch_of_equations_5_13_to_6_6() -> None:
    for reward, branches in BRANCHES.items():
        for made, expected in branches:
            assert worth(reward, made) == pytest.approx(expected, rel=1e-9, abs=1e-9), (reward, made)


@given(
    state=st.tuples(st.floats(-10, 100), st.floats(-500, 500), st.floats(-2e4, 2e4)),
    duration=st.sampled_from([0.15, 0.2]),
    share=st.floats(0, 1),
)
def test_the_quintic_solves_the_six_equations_of_5_16(
    state: tuple[float, float, float], duration: float, share: float
) -> None:
    t = duration
    rows = [  # angle, velocity, acceleration at the start, and at the end
        [1, 0, 0, 0, 0, 0],
        [0, 1, 0, 0, 0, 0],
        [0, 0, 2, 0, 0, 0],
        [1, t, t**2, t**3, t**4, t**5],
        [0, 1, 2 * t, 3 * t**2, 4 * t**3, 5 * t**4],
        [0, 0, 2, 6 * t, 12 * t**2, 20 * t**3],
    ]
    solved = np.polynomial.Polynomial(np.linalg.solve(np.array(rows, np.float64), [*state, 0.0, 0.0, 0.0]))
    now = np.array([share * duration])
    start, speed, acceleration = (np.array([v]) for v in state)
    angle, velocity = quintic(start, speed, acceleration, duration, now)
    assert angle == pytest.approx(solved(now), abs=1e-7)
    assert velocity == pytest.approx(solved.deriv()(now), abs=1e-5)


def test_the_tracking_weights_have_a_common_factor() -> None:
    way = step(x=(35.0, -590.0), k=400, turn=FROM_REST)._replace(tracking=0.1)
    assert worth(trajectory_return, way) == pytest.approx(0.1 * (-10.0 * 9.0 - 0.1 * 100.0))
    out = step(x=(80.0, 0.0), k=300)._replace(tracking=0.1)
    assert worth(trajectory_return, out) == pytest.approx(3000.0 - 200.0 * 25.0)


def test_the_trajectory_rewards_take_the_smallest_eigenvalue_of_two_parameters() -> None:
    before, after = pack(np.diag([7.0, 900.0])), pack(np.array([[50.0, 30.0], [30.0, 50.0]]))  # λ: 7; 20 and 80
    for reward in (trajectory_return, hybrid_return):
        assert worth(reward, step(before, after)) == pytest.approx(13.0)


def test_the_amplified_determinant_rewards() -> None:
    before, after = pack(np.diag([2.0, 3.0])), pack(np.diag([4.0, 6.0]))  # the determinant grows fourfold
    gain = math.log(4.0)
    assert worth(determinant_step, step(before, after)) == pytest.approx(gain, rel=1e-6)  # eq. 4.13
    assert worth(determinant_step, step(before, after, x=(77.0, 0.0))) == pytest.approx(gain - 800.0, rel=1e-6)
    assert worth(determinant_step, step(before, after, violated=True)) == -4e4
    assert worth(determinant_gain, step(before, after)) == pytest.approx(1e4 * gain, rel=1e-6)  # eq. 6.4
    assert worth(squared_determinant_gain, step(before, after)) == pytest.approx(1e4 * gain**2, rel=1e-6)  # eq. 6.5
    assert worth(determinant_gain, step(before, after, x=(77.0, 0.0))) == pytest.approx(1e4 * gain - 800.0, rel=1e-6)
    assert worth(determinant_gain, step(before, after, violated=True)) == -4e4


def grown_matrices(seed: int, count: int, n: int) -> list[Any]:
    rng = np.random.default_rng(seed)
    parts = rng.normal(0.0, 3.0, (count, n, 2))
    return [np.zeros((n, n)), *np.cumsum(parts @ parts.transpose(0, 2, 1), axis=0)]


def test_the_determinant_reward_is_the_one_of_the_running_normalisation() -> None:
    matrices = grown_matrices(1, 30, 2)
    expected, *_ = normalised(np.diff(matrices, axis=0), 1e-6)
    found = [worth(determinant_gain, step(pack(a), pack(b))) for a, b in pairwise(matrices)]
    np.testing.assert_allclose(found, 1e4 * expected, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_the_logarithmic_rewards_add_up_to_their_criterion_from_the_prior_on(n: int) -> None:
    matrices = grown_matrices(2, 20, n)
    eigenvalues = np.linalg.eigvalsh(matrices[-1] + 12.0 * np.eye(n))
    expected: dict[Reward, float] = {
        log_determinant: np.log(eigenvalues).sum() - n * math.log(12.0),
        log_smallest_eigenvalue: math.log(eigenvalues[0]) - math.log(12.0),
        log_trace: -math.log((1.0 / eigenvalues).sum()) + math.log(n / 12.0),
    }
    for reward, value in expected.items():
        total = sum(worth(reward, step(pack(a), pack(b))) for a, b in pairwise(matrices))
        assert total == pytest.approx(value, rel=1e-9)


def test_the_rewards_of_one_parameter_refuse_two() -> None:
    for reward in ONE_PARAMETER:
        require_defined(reward, ("f_v",))
        with pytest.raises(UsageError):
            require_defined(reward, ("k_1", "f_v"))
    require_defined(log_determinant, ("k_1", "f_v"))


def test_a_reward_gets_the_state_in_which_the_way_home_began(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("emb_train.rewards.OUTWARD", 20)
    bench = load_bench()
    batch = Batch(bench, bench.range_set("viscous"), ("f_v",), 1)
    batch.begin(0, np.random.default_rng(0))
    turns, states, informations = list[Turn](), [batch.x], [batch.newest(batch.experiments.m)]
    for _ in range(30):
        batch.advance(np.full(1, 5.0))
        made = transition(batch)
        np.testing.assert_array_equal(made.before, informations[-1])
        turns.append(made.turn)
        states.append(batch.x)
        informations.append(made.after)
    for turn in turns[19:]:
        np.testing.assert_array_equal(turn.x, states[20])
        np.testing.assert_array_equal(turn.m, informations[20])
        assert turn.acceleration == pytest.approx((states[20] - states[19])[:, 1] / 1e-3)
