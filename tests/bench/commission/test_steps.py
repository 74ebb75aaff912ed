"""Steps of a commissioning: what may be done follows from what was found; a contradiction of the data sheet ends it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import onnx
import pytest

from emb_bench.commission.bench_file import (
    MEASURED,
    SHEET,
    found_text,
    measured_range,
    working_text,
)
from emb_bench.commission.examination import noise_in_motion
from emb_bench.commission.records import (
    CurrentCheck,
    Findings,
    FirstMove,
    Identification,
    Velocity,
    noise_problems,
    suspected,
)
from emb_bench.commission.steps import (
    EXPERIMENTS,
    FULL,
    LISTEN,
    ZERO,
    Step,
    Window,
    break_away,
    current_check,
    experiment,
    first_move,
    step_policy,
)
from emb_bench.config.bench import Bench, load_bench, parse_bench
from emb_runtime.config.bench import PARAMETER_NAMES, Noise, Sensors
from emb_runtime.drives.mapping_file import load_mapping
from emb_runtime.errors import BenchFileError, EmbError
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.policy.policy import Policy, load_policy
from emb_runtime.safety.shield_design import make_law
from tests.benches import SENSOR_TEXT
from tests.drives import EXAMPLES

LOGS = "7-medium.mcap and 8-large.mcap"


def sheet_text(factor: float = 2.0, **changed: str) -> str:
    brake = load_bench().brake
    rows = [f"{n} = [{getattr(brake, n) / factor}, {getattr(brake, n) * factor}]" for n in PARAMETER_NAMES]
    text = SENSOR_TEXT.replace("[limits] ", "\n".join(["[ranges.wide]", *rows, "[limits] "]), 1)
    text = text.replace('ranges        = "envelope"', 'ranges = "wide"', 1)
    for key, value in changed.items():
        line = next(line for line in text.splitlines() if line.split("=")[0].strip() == key)
        text = text.replace(line, f"{key} = {value}", 1)
    return text


@pytest.fixture(scope="module")
def sheet() -> Bench:
    return parse_bench(sheet_text(), "sheet")


@pytest.fixture(scope="module")
def work(sheet: Bench) -> Bench:
    return parse_bench(working_text(sheet), "working")


REST = Noise(8e-4, 0.9)
CURRENT = CurrentCheck(0, 0, 1.0, 1e-3)
MOVE = FirstMove(0.75, 0.72, 1.0)


def identification(sheet: Bench, share: float = 0.01, **changed: object) -> Identification:
    values = {name: getattr(sheet.brake, name) for name in PARAMETER_NAMES}
    one = Identification(
        values=values,
        intervals={name: (value * (1 - share), value * (1 + share)) for name, value in values.items()},
        halves=dict.fromkeys(values, (share / 2, share)),
        model="exact",
        fits=True,
        ratio=1.0,
        command_delay=0,
        measurement_delay=0,
        current_lag=(0.0, 0.0),
        features={},
        noise=Noise(9e-4, 0.8),
    )
    return replace(one, **changed)  # type: ignore[arg-type]


def found(sheet: Bench, **changed: object) -> Findings:
    return replace(Findings(REST, CURRENT, MOVE, identification(sheet)), **changed)  # type: ignore[arg-type]


def all_steps(work: Bench) -> list[Step]:
    experiments = [experiment(row, work, MOVE) for row in EXPERIMENTS.values()]
    return [LISTEN, ZERO, current_check(work), first_move(work), *experiments, experiment(FULL, work, MOVE)]


def measured_ranges(sheet: Bench, one: Identification) -> dict[str, tuple[float, float]]:
    return {name: measured_range(sheet, one, name)[:2] for name in PARAMETER_NAMES}


def limit(step: Step) -> float:
    return max(map(abs, step.currents))


def test_nothing_is_sent_before_the_sensors_are_known_and_each_experiment_may_do_more(
    sheet: Bench, work: Bench
) -> None:
    steps = all_steps(work)
    assert [step.stage[0] for step in steps] == ["--read-only", "--zero", *["--limit"] * 7]
    assert ["--home" in step.stage for step in steps] == 3 * [False] + 6 * [True]
    assert limit(steps[0]) == limit(steps[1]) == 0.0
    experiments = steps[4:]
    assert len(experiments) == len(EXPERIMENTS) + 1
    for before, after in itertools.pairwise(experiments):
        assert limit(after) >= limit(before)
        assert after.window.speed >= before.window.speed
        assert after.window.highest >= before.window.highest
        assert after.window.lowest <= before.window.lowest
    for step in steps:
        assert step.stage[0] != "--limit" or float(step.stage[1]) == limit(step)
        assert len(step.currents) <= work.timing.horizon
        assert limit(step) == 0.0 or work.limits.angle[0] <= step.window.lowest
        assert limit(step) == 0.0 or step.window.highest <= sheet.limits.angle[1]


def test_the_current_check_moves_no_brake_of_the_data_sheet_and_the_first_move_every_one(
    sheet: Bench, work: Bench
) -> None:
    least, most = break_away(work)
    steps = all_steps(work)
    assert limit(steps[2]) < least
    assert limit(steps[3]) > most
    assert limit(steps[2]) == pytest.approx(0.06, abs=0.001)  # 5.2e-3 N·m / 0.0434 N·m/A / 2


def require_none(problems: Iterator[EmbError]) -> None:
    for problem in problems:
        raise problem


def check(finding: Noise | CurrentCheck | FirstMove | Identification, sheet: Bench, *, is_first: bool = True) -> None:
    """Compare a finding with the data sheet."""
    match finding:
        case Noise():
            require_none(noise_problems(finding, sheet))
        case Identification():
            require_none(finding.problems(sheet, is_first=is_first))
        case _:
            require_none(finding.problems(sheet))


def test_what_contradicts_the_data_sheet_ends_it(sheet: Bench) -> None:
    for finding, words in (
        (Noise(2e-3, 1.0), "angle scatters"),
        (Noise(1e-3, 1.3), "velocity scatters"),
        (Noise(math.nan, 1.0), "angle scatters"),
        (replace(CURRENT, scale=-1.0), "sign or scale"),
        (replace(CURRENT, scale=math.nan), "sign or scale"),
        (replace(CURRENT, moved=0.1), "the brake moved"),
        (replace(CURRENT, delay=1), "commands act 1 samples late"),
        (replace(MOVE, up=math.nan), "did not move"),
        (replace(MOVE, scale=2.0), "times as far"),
        (identification(sheet, measurement_delay=1), "answers act 1 samples late"),
        (identification(sheet, current_lag=(9e-4, 1.1e-3)), "the current lags by"),
    ):
        with pytest.raises(EmbError, match=words):
            check(finding, sheet)


def test_a_velocity_that_lags_more_than_is_declared_ends_it(sheet: Bench) -> None:
    observed = Velocity(1500.0, 1410.0, 1520.0)
    for declared in (Sensors("observer", 1500.0), Sensors("observer", velocity_lag=1e-3), Sensors("observer", 750.0)):
        require_none(observed.problems(declared))
        require_none(Velocity().problems(declared))
    for declared, words in (
        (Sensors(), "a sensor's"),
        (Sensors("observer", 1600.0), "an observer's, with a bandwidth of at least 1600"),
    ):
        with pytest.raises(EmbError, match=rf'declares {words}.* velocity = "observer" and observer_bandwidth = 1410'):
            require_none(observed.problems(declared))


AWAY = [(2.9, 3.1), (0.3, 0.4), (2.001, 2.003), (0.497, 0.499)]  # Intervals outside of 0.5 to 2
ACROSS = [(1.9, 2.001), (0.499, 0.6), (0.4, 2.5), (math.nan, math.nan), (1.0, math.inf)]  # Partly, or not known


def with_interval(one: Identification, name: str, shares: tuple[float, float]) -> Identification:
    value = one.values[name]
    return replace(one, intervals={**one.intervals, name: (shares[0] * value, shares[1] * value)})


def test_no_range_is_written_that_does_not_hold_the_interval(sheet: Bench) -> None:
    for name, shares, (fits, ratio) in itertools.product(
        PARAMETER_NAMES, AWAY + ACROSS, ((True, 1.0), (False, 1.5), (False, 400.0))
    ):
        one = with_interval(identification(sheet, fits=fits, ratio=ratio), name, shares)
        with pytest.raises(BenchFileError, match=rf"widen {name} in \[ranges\.wide\]"):
            found_text(sheet, found(sheet, identified=one), LOGS)


def test_an_interval_outside_of_a_range_ends_it_and_one_across_a_border_does_not(sheet: Bench) -> None:
    for name in PARAMETER_NAMES:
        for shares in AWAY:
            with pytest.raises(BenchFileError, match=rf"widen {name} in \[ranges\.wide\]"):
                check(with_interval(identification(sheet), name, shares), sheet)
        for shares in ACROSS:  # larger experiments tell
            check(with_interval(identification(sheet), name, shares), sheet)


def test_an_almost_fitting_model_far_outside_of_the_data_sheet_ends_it_from_the_second_experiment_on(
    sheet: Bench,
) -> None:
    one = identification(sheet, fits=False, ratio=0.95, objections=("correct J in the bench file",))
    for share in (5.0, 0.2):
        outside = with_interval(one, "f_v", (0.95 * share, 1.05 * share))
        check(outside, sheet)
        with pytest.raises(EmbError, match=r"f_v is .*: widen f_v in \[ranges\.wide\] of .*; or correct J"):
            check(outside, sheet, is_first=False)
        check(replace(outside, ratio=4.0), sheet, is_first=False)
    check(one, sheet, is_first=False)


def test_where_the_brake_moves_as_none_of_the_set_the_parameter_to_widen_is_named(sheet: Bench) -> None:
    one = identification(sheet, fits=False, ratio=300.0)
    k_1 = sheet.brake.k_1
    said = suspected(sheet, with_interval(one, "k_1", (4.0, 6.0)))
    assert (
        f"k_1 is {4 * k_1:.0f} to {6 * k_1:.0f} N/rad (data sheet {k_1 / 2:.5g} to {k_1 * 2:.5g}): "
        "widen k_1 in [ranges.wide]" in said
    )
    for shares in ((1.5, 9.0), (1.7, 1.9), (0.54, 0.7)):  # across a border, and near to one
        said = suspected(sheet, with_interval(one, "k_1", shares))
        assert "widen k_1 in [ranges.wide]" in said
        assert "look at J and gamma" in said
    for identified in (with_interval(one, "k_1", (0.56, 1.79)), identification(sheet)):
        said = suspected(sheet, identified)
        assert "look at J and gamma" in said
        assert "widen" not in said
    nothing = suspected(sheet, None)
    assert nothing.startswith("no parameter was found yet: look at all of [ranges.wide] first")
    assert not any(said in nothing for said in ("look at J", "widen", "that was found"))


def test_the_last_run_must_not_contradict_the_file(sheet: Bench) -> None:
    written = parse_bench(found_text(sheet, found(sheet), LOGS), "found")
    one = identification(sheet)
    moved = replace(one, intervals={**one.intervals, "T_c": (0.012, 0.013)})
    with pytest.raises(EmbError, match=r"T_c is 0\.012"):
        require_none(moved.changes(written))
    require_none(one.changes(written))


# --- bench files ----------------------------------------------------------------------------------------------------


def test_the_working_bench_has_the_data_sheets_ranges_and_a_shield_for_them(sheet: Bench, work: Bench) -> None:
    assert work.range_set(work.shield.ranges).low == sheet.range_set("wide").low
    assert work.shield.ranges == SHEET
    assert work.limits.angle[1] < 100.0  # the weakest motor does not hold the stiffest spring farther
    make_law(work)
    bare = parse_bench(sheet_text() + "\n[plants.bare]\n", "sheet")
    assert "bare" in parse_bench(working_text(bare), "working").plants  # a table without an entry is kept


def test_until_the_velocity_is_known_a_sheet_that_does_not_say_it_counts_as_of_the_slowest_observer() -> None:
    def sensors(text: str, velocity: Velocity | None = None) -> Sensors:
        return parse_bench(working_text(parse_bench(text, "sheet"), velocity), "working").sensors

    silent = sheet_text()
    declared = f'{silent}\n[sensors]\nvelocity = "observer"\nvelocity_lag = 0.001\n'
    assert sensors(silent) == Sensors("observer", 750.0)
    assert sensors(declared) == Sensors("observer", velocity_lag=1e-3)
    assert sensors(f'{silent}\n[sensors]\nvelocity = "sensor"\n') == Sensors()
    assert sensors(sheet_text(frame_age="[0, 3]")) == Sensors(), "no shield covers it beside late frames"
    for text in (silent, declared):
        assert sensors(text, Velocity(1500.0, 1410.0, 1520.0)) == Sensors("observer", 1410.0)
        assert sensors(text, Velocity()) == Sensors()


def test_the_file_declares_the_velocity_as_it_was_measured() -> None:
    for declared in ("", '\n[sensors]\nvelocity = "observer"\nobserver_bandwidth = 800.0\n'):
        sheet = parse_bench(sheet_text() + declared, "sheet")
        for velocity in (Velocity(), Velocity(1520.0, 1428.8, 1520.0)):
            text = found_text(sheet, found(sheet, identified=identification(sheet, velocity=velocity)), LOGS)
            bench = parse_bench(text, "found")
            assert bench.sensors == velocity.sensors
            assert bench.plants[MEASURED].instruments.observer_bandwidth == velocity.bandwidth
            assert f"# measured with {LOGS}: {velocity}\n" in text


def test_a_data_sheet_without_any_shield_is_refused_with_the_reason() -> None:
    hopeless = parse_bench(sheet_text(6.0), "sheet")
    with pytest.raises(BenchFileError, match="the shield cannot guarantee"):
        working_text(hopeless)


def test_the_file_says_where_each_number_comes_from(sheet: Bench) -> None:
    text = found_text(sheet, found(sheet), LOGS)
    bench = parse_bench(text, "found")
    section = ""
    for line in text.splitlines():
        section = line if line.startswith("[") else section
        if line.split("=")[0].strip() in PARAMETER_NAMES:
            assert ("#" in line) is (section != f"[ranges.{SHEET}]"), line
    assert "7-medium.mcap and 8-large.mcap" in text
    assert bench.shield.ranges == MEASURED
    assert bench.limits == sheet.limits  # as wide as the data sheet's again
    assert bench.noise == Noise(1.08e-3, 1.08)  # 1.2 times the larger of rest and motion
    make_law(bench)


def test_ranges_hold_the_interval_and_are_never_wider_than_the_data_sheets(sheet: Bench) -> None:
    for share, fits in itertools.product((0.001, 0.2, 0.5), (True, False)):
        one = identification(sheet, share, fits=fits)
        for name, (low, high) in measured_ranges(sheet, one).items():
            value, inner = one.values[name], one.intervals[name]
            assert value / 2 * (1 - 1e-12) <= low <= inner[0]
            assert value * 2 * (1 + 1e-12) >= high >= inner[1]
            assert low <= max(value * 0.9, value / 2)


def test_where_nothing_is_explained_the_ranges_stay_the_data_sheets_and_the_file_says_so(sheet: Bench) -> None:
    lost = identification(sheet, fits=False, ratio=400.0)
    assert measured_ranges(sheet, lost) == {
        name: (getattr(sheet.range_set("wide").low, name), getattr(sheet.range_set("wide").high, name))
        for name in PARAMETER_NAMES
    }
    text = found_text(sheet, found(sheet, identified=lost), LOGS)
    assert text.count("no model explains the experiments; residuals 20 times the noise") == len(PARAMETER_NAMES)
    near = measured_ranges(sheet, replace(lost, ratio=1.5))
    assert all(near[name][1] - near[name][0] < sheet.brake._asdict()[name] for name in PARAMETER_NAMES)


def test_a_curve_and_a_hysteresis_of_the_force_widen_the_range_of_its_stiffness(sheet: Bench) -> None:
    plain = measured_ranges(sheet, identification(sheet))["k_1"]
    bent = measured_ranges(sheet, identification(sheet, features={"quadratic": 1e-3, "hysteresis": 0.02}))["k_1"]
    assert bent[1] == pytest.approx(plain[1] * 1.1 * 1.02, rel=1e-4)
    assert bent[0] == pytest.approx(plain[0] * 0.98, rel=1e-4)


def test_with_play_of_the_gear_the_range_of_the_friction_stays_the_data_sheets(sheet: Bench) -> None:
    one = identification(sheet, features={"play": 0.5})
    wide, plain = measured_ranges(sheet, one), measured_ranges(sheet, identification(sheet))
    box = sheet.range_set("wide")
    assert wide.pop("T_c") == (box.low.T_c, box.high.T_c) != plain.pop("T_c")
    assert wide == plain
    assert "the data sheet's, as play acts as friction" in found_text(sheet, found(sheet, identified=one), LOGS)


def test_a_drive_that_does_not_say_which_command_it_obeyed_may_be_a_sample_later() -> None:
    late = parse_bench(sheet_text(frame_age="[0, 3]"), "sheet")
    text = found_text(late, found(late, current=replace(CURRENT, latest=1)), LOGS)
    assert parse_bench(text, "found").shield.frame_age == (0, 1)
    assert "commands act 0 to 1 samples late" in text


def test_a_travel_shorter_than_what_is_tried_is_kept_where_it_has_a_shield() -> None:
    short = parse_bench(sheet_text(1.2, angle="[-10, 8]"), "sheet")
    assert parse_bench(working_text(short), "working").limits.angle == short.limits.angle


def test_the_travel_of_the_file_is_as_long_as_the_ranges_that_were_found_have_a_shield() -> None:
    wide = parse_bench(sheet_text(), "sheet")
    poor = found(wide, identified=identification(wide, fits=False, ratio=400.0))
    bench = parse_bench(text := found_text(wide, poor, LOGS), "found")
    assert bench.limits.angle[1] < wide.limits.angle[1]
    assert "the largest for which a shield covers the ranges" in text
    make_law(bench)


def test_a_lag_and_features_that_were_found_are_in_the_plant_of_the_file() -> None:
    lagging = parse_bench(sheet_text(current_lag="0.002"), "sheet")
    one = identification(lagging, current_lag=(9e-4, 1.1e-3), features={"hysteresis": 0.02})
    bench = parse_bench(found_text(lagging, found(lagging, identified=one), LOGS), "found")
    assert 1.3e-3 < bench.shield.current_lag < 1.5e-3
    plant = bench.plants[MEASURED]
    assert plant.mechanics.current_lag == pytest.approx(1e-3)
    assert plant.mechanics.hysteresis == pytest.approx(0.02)
    # A lag that is shorter than a plant may have is left out of it, and bounded all the same.
    short = found(lagging, identified=identification(lagging, current_lag=(0.0, 1.9e-5)))
    bench = parse_bench(found_text(lagging, short, LOGS), "found")
    assert bench.plants[MEASURED].mechanics.current_lag == 0.0
    assert bench.shield.current_lag >= 1.9e-5


def test_a_file_that_was_found_may_be_the_next_data_sheet_and_leaves_nothing_of_its_plant(sheet: Bench) -> None:
    text = found_text(sheet, found(sheet, identified=identification(sheet, features={"hysteresis": 0.02})), LOGS)
    again = parse_bench(text, "the next data sheet")
    assert again.plants[MEASURED].mechanics.hysteresis == 0.02
    plain = parse_bench(found_text(again, found(again), LOGS), "found")
    assert plain.plants[MEASURED].mechanics.hysteresis == 0.0


STEP = Step("try", 0.5, (), Window(-1.0, 2.0, 30.0), currents=(1.0, 1.0, -1.5, 0.25))

ESTIMATOR = Estimator(load_bench())


@pytest.fixture(scope="module")
def policy() -> Policy:
    bench = load_bench()
    return load_policy(step_policy(STEP, bench), bench)


def test_the_file_is_onnx_by_the_reference_checker() -> None:
    model = onnx.load_from_string(step_policy(STEP, load_bench()))
    onnx.checker.check_model(model, full_check=True)


def test_inside_of_the_window_the_sequence_is_played_and_its_end_stays(policy: Policy) -> None:
    assert [policy.act(0.5, 1.0, k, ESTIMATOR) for k in range(6)] == [1.0, 1.0, -1.5, 0.25, 0.25, 0.25]


def test_outside_of_it_no_current_drives_farther_out(policy: Policy) -> None:
    for angle, velocity, step in itertools.product((-1.5, 0.0, 2.5), (-31.0, 0.0, 31.0), (0, 2)):
        wanted = STEP.currents[step]
        farther = (angle > 2.0 or velocity > 30.0) if wanted > 0.0 else (angle < -1.0 or velocity < -30.0)
        assert policy.act(angle, velocity, step, ESTIMATOR) == (0.0 if farther else wanted)


def test_steps_add_to_the_noise_of_a_brake_that_moves_and_our_own_node_has_none_to_speak_of() -> None:
    at_rest = Noise(8e-4, 0.6)
    moving = noise_in_motion(at_rest, load_mapping(EXAMPLES / "mit.toml"))
    turned = np.random.default_rng(4).uniform(0.0, 10.0, 20_000)
    step = 9 * 25.0 / 65535  # a gear of 9; the protocol's 16 bits from -12.5 to 12.5 rad
    shown = step * np.floor((turned + np.random.default_rng(5).normal(0.0, 8e-4, turned.shape)) / step)
    assert moving.angle == pytest.approx(np.std(shown - turned), rel=0.03)
    assert noise_in_motion(at_rest, None) == at_rest
