"""The environment: the plant, the shield and the information of the other rooms, in Gymnasium's terms."""

from __future__ import annotations

import copy
import dataclasses
import math
import pickle
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.config.bench import Bench, load_bench
from emb_bench.config.plants import Instruments, Plant
from emb_bench.estimate.expected import IntervalCriterion, of_experiment, sampled
from emb_bench.information.evaluation import Question
from emb_bench.information.symmetric import unpack
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters
from emb_runtime.errors import UsageError
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.estimator.speed_loop import current_for
from emb_train.closed_loop import Batch, Conditions, Experiments, advance
from emb_train.env import ENV_ID, EmbExcitationEnv, EmbExcitationVectorEnv
from emb_train.lies import LIES
from emb_train.presets import preset_summaries
from emb_train.rewards import (
    Demands,
    ExpectedInterval,
    Precision,
    TimeToPrecision,
    Transition,
    penalised_increment,
)
from emb_train.training import load_preset

from tests.bench.flows import fisher  # isort: skip
from tests.benches import SENSOR_BENCH

BENCH = SENSOR_BENCH
SHORT = dataclasses.replace(BENCH, timing=dataclasses.replace(BENCH.timing, horizon=60))


def trace_increment(t: Transition) -> Any:
    """A reward for any number of parameters."""
    return (t.after - t.before).sum(axis=1)


def actions(seed: int, steps: int) -> Any:
    """Random actions that hold for a while and reach beyond the bounds."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-1.5, 1.5, (steps // 10 + 1, 1)), 10, axis=0)[:steps].astype(np.float32)


PLANTS = {
    "fast": Plant("fast", BENCH.plant("exact").mechanics, Instruments(clock_jitter=2e-5, encoder_offset=0.1)),
    "slow": Plant(
        "slow",
        BENCH.plant("exact").mechanics,
        Instruments(command_delay=2, measurement_delay=3, observer_bandwidth=1000.0),
    ),
}
MANY = dataclasses.replace(SHORT, plants={**SHORT.plants, **PLANTS})


OPEN = Conditions(shielded=False, horizon=30, observes="everything", information="physical")
VARYING = Conditions(command_delay=(0, 2))
FOLLOWED = Conditions(acts="speed", observes="estimate", information="physical")


def test_gymnasium_finds_nothing_wrong_with_the_registered_environment() -> None:
    for conditions in (Conditions(), OPEN, Conditions(shielded=False), FOLLOWED):
        check_env(gymnasium.make(ENV_ID, conditions=conditions).unwrapped, skip_render_check=True)
    env = gymnasium.make_vec(ENV_ID, num_envs=3)
    assert isinstance(env.unwrapped, EmbExcitationVectorEnv)
    observation, _ = env.reset(seed=1)
    assert env.observation_space.contains(observation)
    assert env.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP


@pytest.mark.parametrize(
    "code",
    [
        "import gymnasium; gymnasium.make('emb_train:EmbExcitation-v0')",
        "import gymnasium, emb_train; gymnasium.make('EmbExcitation-v0')",
        "import gymnasium; gymnasium.make('emb_train.env:EmbExcitation-v0')",
        "import emb_train.env, gymnasium; gymnasium.make_vec('emb_train:EmbExcitation-v0', num_envs=2)",
    ],
)
def test_gymnasium_finds_the_environment_by_its_name(code: str) -> None:
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)


def compare_infos(vector: dict[str, Any], row: int, scalar: dict[str, Any]) -> None:
    for name, value in scalar.items():
        np.testing.assert_array_equal(vector[name][row], value, err_msg=name)


@given(seed=st.integers(0, 2**40), conditions=st.sampled_from([Conditions(), OPEN, VARYING, FOLLOWED]))
@settings(max_examples=5, deadline=None)
def test_the_vector_environment_is_the_scalar_one_step_for_step_and_reset_for_reset(
    seed: int, conditions: Conditions
) -> None:
    kind: dict[str, Any] = {"bench": SHORT, "ranges": "pm50", "parameters": PARAMETER_NAMES, "reward": trace_increment}
    kind["conditions"] = conditions
    many, ones = EmbExcitationVectorEnv(3, **kind), [EmbExcitationEnv(**kind) for _ in range(3)]
    seen, info = many.reset(seed=np.int64(seed))  # type: ignore[arg-type]  # as numpy draws it
    for i, env in enumerate(ones):
        first, first_info = env.reset(seed=seed + i)
        np.testing.assert_array_equal(seen[i], first)
        compare_infos(info, i, first_info)
    sequence = [actions(seed + i, 130) for i in range(3)]
    for k in range(130):  # two whole experiments and the beginning of a third
        seen, rewards, terminated, truncated, info = many.step(np.stack([a[k] for a in sequence]))
        for i, env in enumerate(ones):
            one = env.step(sequence[i][k])
            assert (rewards[i], terminated[i], truncated[i]) == one[1:4]
            assert not one[3]  # the horizon is a terminal, never a truncation
            last_seen, last_info = one[0], one[4]
            if one[2]:
                np.testing.assert_array_equal(info["final_obs"][i], last_seen)
                compare_infos(info["final_info"], i, last_info)
                last_seen, last_info = env.reset()
            np.testing.assert_array_equal(seen[i], last_seen)
            compare_infos(info, i, last_info)


def test_brakes_and_noise_are_drawn_at_each_reset_and_nothing_else() -> None:
    ranges, f_v = BENCH.range_set("viscous"), BrakeParameters._fields.index("f_v")
    batch, rng = Batch(BENCH, ranges, ("f_v",), 400), np.random.default_rng(0)
    for i in range(400):
        batch.begin(i, rng)
    drawn = batch.experiments.brakes[:, f_v]
    assert ranges.low.f_v <= drawn.min() < 1.1e-5
    assert 4.9e-5 < drawn.max() <= ranges.high.f_v
    assert drawn.mean() == pytest.approx(3e-5, rel=0.05)
    assert (np.delete(batch.experiments.brakes, f_v, axis=1) == np.array(BENCH.brake)[:-1]).all()
    errors = []
    for _ in range(50):
        errors.append(batch.experiments.y - batch.x)
        batch.advance(np.zeros(400))
    deviations = np.std(np.concatenate(errors), axis=0)
    assert deviations == pytest.approx([BENCH.noise.angle, BENCH.noise.velocity], rel=0.03)
    states = []
    for plant in ("euler", "exact", "fast"):  # ideal instruments draw no more random numbers than the noise
        rng = np.random.default_rng(0)
        fixed = Batch(MANY, MANY.range_set("nominal"), ("f_v",), 1, plant=plant)
        fixed.begin(0, rng)
        assert (fixed.experiments.brakes == np.array(BENCH.brake)).all()
        states.append(rng.random())
    assert states[0] == states[1] != states[2]


def test_the_information_and_the_return_are_those_of_the_sent_currents() -> None:
    for plant, kind in (("euler", "weighted"), ("exact", "weighted"), ("exact", "physical")):
        conditions = Conditions(information=kind)  # type: ignore[arg-type]  # one of its names
        names = PARAMETER_NAMES if kind == "physical" else ("f_v",)
        settings_: dict[str, Any] = {"plant": plant, "conditions": conditions, "parameters": names, "scale": 1e-7}
        env, brake = EmbExcitationEnv(reward=trace_increment, **settings_), BENCH.brake._replace(f_v=4e-5)
        env.reset(seed=2, options={"brakes": [brake]})
        currents, total = [], 0.0
        for action in actions(1, BENCH.timing.horizon):
            _, reward, terminated, _, info = env.step(action)
            currents.append(info["current"])
            total += reward
        alone = fisher(BENCH, brake, currents, params=names, kind=kind, plant=BENCH.plant(plant))  # type: ignore[arg-type]  # as above
        np.testing.assert_allclose(unpack(info["fim"], len(names)), alone.matrix, rtol=1e-8, atol=1e-6)
        assert total == pytest.approx(1e-7 * info["fim"].sum(), rel=1e-9)
        assert terminated


def test_every_plant_is_the_same_in_plain_python_and_compiled() -> None:
    for plant in ("exact", "fast", "slow"):
        batch = Batch(MANY, MANY.range_set("pm50"), PARAMETER_NAMES, 2, plant)
        for i in range(2):
            batch.begin(i, np.random.default_rng(7 + i))
        plain = Experiments._make(array.copy() for array in batch.experiments)
        for action in 6.0 * actions(4, 59).astype(np.float64):
            wanted = np.concatenate([action, -action])
            batch.advance(wanted)
            advance(batch.setup, plain, wanted)
        pairs: Any = zip(Experiments._fields, plain, batch.experiments, strict=True)
        for name, own, other in pairs:
            same = np.array_equal(own, other) if isinstance(own, np.ndarray) else list(own) == list(other)
            assert same, f"{plant}: {name}"


def test_the_critic_sees_the_truth_in_scales_of_order_one() -> None:
    env = EmbExcitationVectorEnv(64, BENCH)
    _, info = env.reset(seed=0)
    seen = [info["critic"]]
    seen += [env.step(np.full((64, 1), 1.0 if k < 190 else -1.0, np.float32))[4]["critic"] for k in range(499)]
    everything = np.concatenate(seen)
    assert everything.shape[1] == 7
    assert np.abs(everything).max() < 5.0
    batch = env.batch
    np.testing.assert_allclose(seen[-1][:, 0], batch.x[:, 0] / 100.0, rtol=1e-6)
    np.testing.assert_allclose(seen[-1][:, 1], batch.x[:, 1] / 500.0, rtol=1e-6)
    np.testing.assert_allclose(seen[-1][:, 2], 499 / 500)
    np.testing.assert_allclose(seen[-1][:, 3], (batch.experiments.brakes[:, 5] - 3e-5) / 2e-5, rtol=1e-5)
    np.testing.assert_allclose(seen[-1][:, 4], 0.1 * np.log1p(batch.newest(batch.experiments.m)[:, 0]), rtol=1e-6)


def test_with_the_shield_every_brake_of_the_range_stays_inside_the_limits_and_comes_home() -> None:
    other = {"ranges": "viscous-stiffness", "parameters": ("k_1", "f_v"), "reward": trace_increment}
    with pytest.raises(UsageError):
        EmbExcitationVectorEnv(2, **other)  # type: ignore[arg-type]  # the shipped shield does not cover these
    wider = dataclasses.replace(BENCH, shield=BENCH.shield._replace(ranges="viscous-stiffness"))
    covered: dict[str, Any] = {**other, "bench": wider}
    wide: dict[str, Any] = {"ranges": "envelope", "parameters": PARAMETER_NAMES, "reward": trace_increment}
    for kind in (wide, covered):
        env = EmbExcitationVectorEnv(60, **kind)
        env.reset(seed=8)
        for _ in range(BENCH.timing.horizon):
            actions_ = np.repeat([[1.0], [-1.0], [0.3]], 20, axis=0).astype(np.float32)
            _, _, terminated, _, info = env.step(actions_)
        assert terminated.all()
        assert not info["final_info"]["violated"].any()
        assert info["final_info"]["home"].all()


def test_parameters_that_cannot_be_trained_are_refused() -> None:
    several = ("f_v", "k_1")
    cases: list[dict[str, Any]] = [{"parameters": p} for p in ((), several, ("J",))]
    for arguments in (*cases, {"parameters": several, "reward": trace_increment}):
        with pytest.raises(UsageError):
            EmbExcitationEnv(**arguments)


def test_calls_that_do_not_fit_the_experiments_are_refused() -> None:
    one, many = EmbExcitationEnv(bench=SHORT), EmbExcitationVectorEnv(2, SHORT)
    calls: list[Callable[[], object]] = [
        lambda: one.step(np.zeros(1, np.float32)),  # before the first reset
        lambda: many.step(np.zeros((2, 1), np.float32)),
        lambda: one.reset(options={"brake": BENCH.brake}),
        lambda: many.reset(options={"brakes": [BENCH.brake]}),
        lambda: many.reset(options={"brakes": [BENCH.brake, tuple(BENCH.brake)]}),
        lambda: many.reset(options={"brakes": [BENCH.brake, BENCH.brake._replace(T_c=1e300)]}),
        lambda: many.reset(seed=[1, 2, 3]),
    ]
    for call in calls:
        with pytest.raises(UsageError):
            call()
    many.reset(seed=0)
    for shape in [(1, 1), (3, 1), (2, 2), (0, 1)]:
        with pytest.raises(UsageError):
            many.step(np.zeros(shape, np.float32))
    one.reset(seed=0)
    for _ in range(60):
        one.step(np.zeros(1, np.float32))
    with pytest.raises(UsageError):
        one.step(np.zeros(1, np.float32))  # beyond the horizon


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_of_an_environment_goes_on_as_the_original_does(copied: Callable[[Any], Any]) -> None:
    envs: list[tuple[Any, tuple[int, ...], int]] = [
        (EmbExcitationEnv(bench=SHORT, conditions=FOLLOWED), (1,), 60),
        (EmbExcitationVectorEnv(2, SHORT), (2, 1), 90),  # which begin again by themselves
    ]
    for env, shape, count in envs:
        env.reset(seed=3)
        steps = [np.full(shape, action) for action in actions(4, count)]
        for step in steps[:20]:
            env.step(step)
        other = copied(env)
        for step in steps[20:]:
            np.testing.assert_equal(other.step(step), env.step(step))


def test_without_a_shield_an_action_is_clipped_and_leaving_the_limits_ends_the_experiment_with_the_penalty() -> None:
    env = EmbExcitationEnv(bench=BENCH, reward=penalised_increment, scale=1.0, conditions=Conditions(shielded=False))
    env.reset(seed=0, options={"brakes": [BENCH.brake]})
    rewards, currents, terminated = [], [], False
    while not terminated:
        _, reward, terminated, truncated, info = env.step(np.full(1, 1.5, np.float32))
        rewards.append(reward)
        currents.append(info["current"])
    assert info["violated"]
    assert not truncated
    assert set(currents) == {6.0}
    assert abs(env.state[1]) > BENCH.limits.velocity
    assert rewards[-1] == -4e4
    assert min(rewards[:-1]) >= 0.0
    for conditions in (Conditions(), Conditions(shielded=False)):
        env = EmbExcitationEnv(conditions=conditions)
        env.reset(seed=0)
        _, reward, _, _, info = env.step(np.array([np.nan], np.float32))  # counts as no current
        assert info["current"] == 0.0
        assert np.isfinite(reward)


def test_an_actor_that_is_told_everything_sees_what_the_critic_sees_without_the_sensitivities() -> None:
    for parameters, size in ((("f_v",), 5), (("k_1", "f_v"), 8)):
        env = EmbExcitationEnv(bench=BENCH, parameters=parameters, reward=trace_increment, conditions=OPEN)
        seen, _ = env.reset(seed=0)
        for _ in range(20):
            seen, _, _, _, info = env.step(np.full(1, 0.8, np.float32))
        assert seen.shape == env.observation_space.shape == (size,)
        np.testing.assert_array_equal(seen, info["critic"][:size])


# Returns of two experiments, as they were when the shipped actors were trained: where one changes, a training with the
# same seed gives another actor
RETURNS = {
    "four-d": [4.41713021679268, 4.018446358739774],
    "interval": [44.40225533929979, 48.89053952038894],
    "quick": [-3.6556924294343434, -3.0530412204520814],
    "single-viscous": [1.2244501298563382, 0.4338971396942164],
    "thesis-adaptive": [0.3862949035181224, -0.2751832232017431],
    "thesis-d-optimal-1": [5.227789652346356, 5.391384300920728],
    "thesis-d-optimal-2": [3.038522269643976, 2.9601273707963034],
    "thesis-d-optimal-plain": [0.0005227789652346361, 0.0005391384300920726],
    "thesis-e-optimal-hybrid": [-0.40236825715569596, -0.3940247462936297],
    "thesis-e-optimal-trajectory": [-0.3206947723891344, -0.39798425915512853],
    "thesis-fixed": [0.2242438968410853, 0.2040730312366346],
    "thesis-random": [0.446562055940387, 0.2419461024188243],
    "thesis-trajectory-a": [-0.057176195163784756, -0.6493520366727297],
    "thesis-trajectory-b": [-0.057176195163784756, -0.6493520366727297],
}


@pytest.mark.parametrize("name", preset_summaries())
def test_the_environment_of_every_preset_pays_for_the_same_actions_what_it_paid_when_it_was_trained_in(
    name: str,
) -> None:
    preset = load_preset(name)
    (env, *_) = preset.environments(load_bench(), 2)
    seen, _ = env.reset(seed=7)
    assert seen.shape == (2, preset.conditions.observation_size(len(preset.parameters)))
    steps = env.batch.bench.timing.horizon
    total = np.sum([env.step(action)[1] for action in held(5, 500, 2)[:steps]], axis=0)
    assert total == pytest.approx(RETURNS[name], rel=1e-6)


# Speeds and estimates


def held(seed: int, steps: int, rows: int) -> Any:
    """Random speeds that hold for a while, as parts of the limit, shape [steps, rows, 1]."""
    levels = np.random.default_rng(seed).uniform(-0.1, 0.4, (steps // 15 + 1, rows, 1))
    return np.repeat(levels, 15, axis=0)[:steps].astype(np.float32)


@pytest.mark.parametrize(
    "bench", [SHORT, dataclasses.replace(load_bench(), timing=SHORT.timing)], ids=["sensor", "observer"]
)
def test_a_speed_becomes_the_current_of_the_runtimes_loop_and_the_estimate_is_that_of_the_runtime(bench: Bench) -> None:
    env = EmbExcitationVectorEnv(3, bench, "pm50", PARAMETER_NAMES, trace_increment, conditions=FOLLOWED)
    seen, _ = env.reset(seed=4)
    batch, estimators, asked = env.batch, [Estimator(bench) for _ in range(3)], 0
    for action in held(1, 60, 3):
        before = batch.experiments.k.copy()
        for i, estimator in enumerate(estimators):
            angle, velocity = batch.experiments.y[i].tolist()
            estimator.add_sample(angle, velocity, float(before[i]), float(batch.newest(batch.experiments.applied)[i]))
            np.testing.assert_array_equal(
                seen[i], np.array([*batch.experiments.y[i], before[i], *estimator.parameters], np.float32)
            )
        assert env.observation_space.contains(seen)
        seen, _, _, _, info = env.advance(action)
        for i, estimator in enumerate(estimators):
            speed = bench.limits.velocity * float(action[i, 0])
            wanted = current_for(estimator.model, estimator.state, estimator.relative, speed, 1.0)
            if info["reasons"][i] == 0:
                assert info["current"][i] == wanted
                asked += 1
    assert asked > 20


@pytest.mark.parametrize("plant", ["exact", "stribeck"])
def test_the_reward_of_a_whole_experiment_is_the_criterion_of_the_interval_that_its_currents_lead_to(
    plant: str,
) -> None:
    free = ExpectedInterval(IntervalCriterion("T"), Demands(hidden=0.0))
    env = EmbExcitationVectorEnv(2, SHORT, "pm50", PARAMETER_NAMES, free, 0.5, plant, FOLLOWED)
    for _ in range(2):  # the second time from arrays that are not new
        env.reset(seed=4)
        acted, paid = [], []
        for action in held(2, 60, 2):
            _, rewards, _, _, _ = env.advance(action)
            acted.append(env.batch.newest(env.batch.experiments.applied))
            paid.append(rewards)
        assert not np.any(paid[:-1])
        assert env.batch.home.all()
        brakes = env.batch.experiments.brakes.tolist()
        for currents, brake, found in zip(np.transpose(acted), brakes, paid[-1], strict=True):
            known = BrakeParameters(*brake)
            information = of_experiment(
                SHORT,
                SHORT.model(plant),
                known,
                sampled(SHORT, SHORT.model(plant), currents),
                Question(PARAMETER_NAMES),
            )
            assert found == pytest.approx(0.5 * information.of_comparison, rel=1e-9)


def test_an_experiment_pays_for_the_release_side_for_what_lies_it_hides_and_for_not_coming_home() -> None:
    criterion = IntervalCriterion("T")
    env = EmbExcitationVectorEnv(2, SHORT, "pm50", PARAMETER_NAMES, ExpectedInterval(criterion), 1.0, "exact", FOLLOWED)
    env.reset(seed=4)
    for action in held(2, 60, 2):
        env.advance(action)
    batch, motion = env.batch, env.batch.experiments.x
    motion[:] = 0.0

    def reward(**demands: float) -> np.ndarray:
        return ExpectedInterval(criterion, Demands(**demands))(batch)

    assert (reward(hidden=0.0) - reward()).tolist() == pytest.approx([len(LIES) * 1.15 * 10.0] * 2)  # nothing moved
    motion[1, 30, 0] = 0.3 * SHORT.limits.angle[0] - 2.5
    np.testing.assert_allclose(reward(hidden=0.0, beyond=0.0) - reward(hidden=0.0), [0.0, 2.5], atol=1e-12)
    motion[1, 60, 0] = 20.0  # not at home
    np.testing.assert_allclose(reward(hidden=0.0, astray=0.0) - reward(hidden=0.0), [0.0, 20.0], atol=1e-12)
    batch.experiments.k[0] = 59  # goes on
    assert (reward() != 0.0).tolist() == [False, True]


def test_the_reward_of_a_time_counts_periods_until_every_estimate_is_precise() -> None:
    reward = TimeToPrecision(Precision(repeatability=0.25, price=0.0))
    env = EmbExcitationVectorEnv(3, SHORT, "pm50", PARAMETER_NAMES, reward, 1.0, conditions=FOLLOWED)
    env.reset(seed=4)
    total, missing = np.zeros(3), []
    for action in held(3, 60, 3):
        _, rewards, _, _, _ = env.advance(action)
        told = env.batch.estimate()
        missing.append((told[:, 4:] / told[:, :4]).max(axis=1) / 0.25)
        total -= rewards
    assert (np.min(missing, axis=0) < 1.0).any()
    for periods, ratios in zip(total, np.transpose(missing), strict=True):
        known = int(np.argmax(ratios <= 1.0)) if (ratios <= 1.0).any() else 60
        assert known <= periods + 1e-9 <= known + 1.0 + 1e-9
        if 0 < known < 60:
            before, after = math.log(np.min(ratios[:known])), math.log(ratios[known])
            assert periods == pytest.approx(known + before / (before - after))


def test_an_experiment_whose_estimates_are_known_returns_and_pays_for_the_interval_of_its_record() -> None:
    asked = Precision(repeatability=0.25, interval=0.001, price=3.0)
    where = (3, BENCH, "pm50", PARAMETER_NAMES)
    env = EmbExcitationVectorEnv(*where, TimeToPrecision(asked), 1.0, conditions=FOLLOWED)
    free = EmbExcitationVectorEnv(
        *where, TimeToPrecision(msgspec.structs.replace(asked, price=0.0)), 1.0, conditions=FOLLOWED
    )
    env.reset(seed=4)
    free.reset(seed=4)
    acted, paid, home = [], np.zeros(3), np.full(3, 500)
    for action in held(3, 300, 3):
        _, rewards, _, _, _ = env.advance(action)
        _, periods, _, _, _ = free.advance(action)
        paid += periods - rewards
        acted.append(env.batch.newest(env.batch.experiments.applied))
        arrived = env.batch.experiments.returning & env.batch.home
        home = np.where(arrived, np.minimum(home, len(acted)), home)
    assert (home < 300).all()  # the shield alone would bring it home at the horizon of 500
    for i, brake in enumerate(env.batch.experiments.brakes.tolist()):
        currents = np.array(acted)[: home[i], i]
        model = BENCH.model("exact")
        found = of_experiment(
            BENCH, model, BrakeParameters(*brake), sampled(BENCH, model, currents), Question(PARAMETER_NAMES)
        )
        wide = np.maximum(found.between_runs[:4] / 0.001, 1.0)
        assert paid[i] == pytest.approx(3.0 * np.log(wide).sum(), rel=1e-9)
        assert paid[i] > 0.0


def test_systematic_errors_are_drawn_from_the_benchs_priors_and_show_where_they_belong() -> None:
    wrong = Conditions(shielded=False, systematic=True)
    many = Batch(SHORT, SHORT.range_set("pm50"), PARAMETER_NAMES, 600, conditions=wrong)
    for i in range(600):
        many.begin(i, np.random.default_rng(i))
    priors = SHORT.systematic
    expected = [priors.offset, priors.current_offset]
    np.testing.assert_allclose(many.experiments.errors.std(axis=0), expected, rtol=0.1)
    assert many.experiments.y[:, 0].std() == pytest.approx(math.hypot(priors.offset, SHORT.noise.angle), rel=0.1)
    offset, current = 0.3, 0.5
    clean, marred = (
        Batch(SHORT, SHORT.range_set("pm50"), PARAMETER_NAMES, 1, conditions=Conditions(shielded=False))
        for _ in range(2)
    )
    for batch in (clean, marred):
        batch.begin(0, np.random.default_rng(7))
    marred.experiments.errors[0] = offset, current
    for wanted in (3.0, 3.0, -1.0, 2.0):
        clean.advance(np.array([wanted + current]))
        marred.advance(np.array([wanted]))
        np.testing.assert_allclose(marred.x, clean.x, rtol=1e-12)
        np.testing.assert_allclose(marred.experiments.y, clean.experiments.y + np.array([offset, 0.0]), rtol=1e-9)
        assert marred.newest(marred.experiments.applied)[0] == wanted
