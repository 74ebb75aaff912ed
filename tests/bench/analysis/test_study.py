"""Studies of runs: what is concluded on each parameter, remedies that give the brake, and the clamping force."""

from __future__ import annotations

import re
import shlex
import shutil
import tomllib
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from emb_bench import api
from emb_bench.analysis.clamping import clamping
from emb_bench.analysis.conclusion import Standing, conclude
from emb_bench.analysis.options import EstimateOptions
from emb_bench.analysis.profile import profile
from emb_bench.analysis.stages import make_study
from emb_bench.analysis.study import Code, Study, verdict
from emb_bench.api import simulate as simulate_run
from emb_bench.batch.evaluate import evaluate_one
from emb_bench.batch.row import CampaignOptions, Source
from emb_bench.config.bench import Bench, parse_bench
from emb_bench.estimate.effects import EFFECTS, possible
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.records import EstimationProblem
from emb_bench.experiment.experiment import Experiment
from emb_bench.information.identifiability import Doubt
from emb_bench.logs.log import RunLog, read_log
from emb_bench.report.estimate import study_document, study_text
from emb_bench.report.information import DOUBTS
from emb_bench.report.sentences import alarms, apart, remedies
from emb_bench.report.sentences import profile as sentence
from emb_runtime.config.bench import PARAMETER_NAMES, shipped_bench_text
from emb_runtime.errors import UsageError
from tests.bench.conftest import Replay
from tests.bench.measurements import currents_of, fit, record
from tests.bench.report_pages import make
from tests.bench.simulated_logs import square, write_log
from tests.benches import SENSOR_TEXT
from tests.conftest import Simulate

Log = Callable[[str], RunLog]
PAIR = ("k_m", "f_v")


@pytest.fixture
def log(tmp_path: Path, simulate: Simulate) -> Log:
    """A log of a simulated run by its options."""

    def made(options: str) -> RunLog:
        return read_log(
            write_log(tmp_path / f"{len(list(tmp_path.iterdir()))}.mcap", simulate(square, options=options))
        )

    return made


def estimated(bench: Bench, *records: Experiment, **asked: object) -> Estimate:
    return fit(bench, "exact", records, EstimationProblem(**asked))  # type: ignore[arg-type]


def test_a_record_that_is_not_predicted_decides_like_residuals_that_do_not_fit(bench: Bench, log: Log) -> None:
    together = make_study(
        bench, [log("plant=exact,seed=1"), log("plant=exact,seed=3")], EstimateOptions(PAIR, starts=1)
    )
    assert len(together.checks.held_out) == 2
    assert verdict(together).holds
    first, second = together.checks.held_out
    found = replace(together, checks=replace(together.checks, held_out=(replace(first, fits=False), second)))
    assert found.model_fits
    assert all(c.standing is Standing.IF_MODEL_RIGHT for c in conclude(found.estimate, (), (), predicts=False))
    got = study_document(found)
    assert (got["model_fits"], got["predicts"]) == (True, False)
    assert verdict(found).model is Code.DOES_NOT_PREDICT


def test_logs_have_to_be_of_one_brake_and_time_grid_and_each_run_is_given_once(
    bench: Bench, log: Log, tmp_path: Path
) -> None:
    first, other = log("plant=exact"), log("plant=stribeck")
    slow = parse_bench(SENSOR_TEXT.replace("sample_time = 1.0e-3", "sample_time = 2.0e-3"), "slow")
    copy = read_log(shutil.copy(first.path, tmp_path / "copy.mcap"))
    for its, logs, said in (
        (bench, [first, other], "different brakes"),
        (slow, [first], "sample time"),
        (bench, [first, log("plant=exact,seed=2"), copy], "each run once"),
    ):
        with pytest.raises(UsageError, match=said):
            make_study(its, logs, EstimateOptions(PAIR, starts=1))


def test_a_conclusion_takes_the_profile_s_interval_and_its_doubts(bench: Bench) -> None:
    """A brake that stands tells its friction from below only, which no information matrix knows."""
    data = record(bench, bench.plant("exact"), np.full(200, 0.9 * bench.brake.T_c / bench.brake.k_m))
    e = estimated(bench, data, params=("T_c",))
    of_profile = profile(e, "T_c")
    (found,) = conclude(e, [of_profile], ())
    assert found.interval == of_profile.interval
    assert not found.identified


def test_a_parameter_of_a_wrong_model_is_identified_only_if_the_model_were_right(bench: Bench) -> None:
    e = estimated(bench, record(bench, bench.plant("stribeck"), currents_of(bench, "chirp")))
    assert not e.validation.fits
    plain, profiled = conclude(e, (), ()), conclude(e, [profile(e, "k_m")], ())
    assert all(c.standing is Standing.IF_MODEL_RIGHT for c in plain)
    assert profiled[0].interval == plain[0].interval  # the profile takes the bench's noise for all there is


def test_nuisances_are_concluded_on_but_do_not_decide(bench: Bench, log: Log) -> None:
    """Where the clamping begins does not show in a run that never clamps."""
    away = np.full(80, -0.8)
    e = estimated(bench, record(bench, bench.plant("exact"), away), params=("f_v",), nuisances=("k_1",))
    interest, nuisance = conclude(e, (), ())
    assert (interest.of_interest, interest.identified) == (True, True)
    assert (nuisance.of_interest, nuisance.identified) == (False, False)
    study = make_study(bench, [log("plant=exact")], EstimateOptions(PAIR, starts=1))
    assert replace(study, conclusions=(interest, nuisance)).unidentified == ()


def test_estimate_profile_and_campaign_agree_on_what_a_run_that_was_cut_short_identifies(
    bench: Bench, tmp_path: Path, simulate: Simulate
) -> None:
    asked = iter(range(10**6))
    stopped = simulate(square, options="plant=exact,seed=1", stop_requested=lambda: next(asked) > 545)
    for run, steps in ((simulate(square, options="plant=exact", steps=12), 12), (stopped, 500)):
        path = write_log(tmp_path / f"{steps}.mcap", run, steps=steps)
        logs = [read_log(path)]
        plain, profiled = (make_study(bench, logs, EstimateOptions(starts=1, profile=p)) for p in (False, True))
        row = evaluate_one(Source(str(path), "", path.name, "."), CampaignOptions(starts=1))
        identified = [c.identified for c in plain.conclusions]
        assert identified == [c.identified for c in profiled.conclusions]
        assert identified == [row[f"{c.label}_identified"] for c in plain.conclusions]
        assert steps == 500 or not all(identified)
    assert plain.stops[0].reason == "INTERRUPTED"


def test_the_bias_of_recursive_least_squares_is_not_held_against_the_model(bench: Bench, log: Log) -> None:
    study = make_study(bench, [log("plant=exact,seed=1")], EstimateOptions(PAIR, method="rls"))
    assert verdict(study).model is Code.BIASED_METHOD
    assert {c.standing for c in study.conclusions} <= {Standing.BIASED, Standing.NOT_IDENTIFIED}
    assert study.minima == []


def test_an_interval_that_holds_zero_identifies_nothing(bench: Bench) -> None:
    e = estimated(bench, record(bench, bench.plant("exact"), currents_of(bench, "chirp")), params=("k_m",))
    wide = replace(e, information=e.information / e.information * 1.7**2)
    (found,) = conclude(wide, (), ())
    assert found.finding.doubts == (Doubt.CONTAINS_ZERO,)


def test_two_brakes_in_one_call_are_said_to_fit_each_alone(bench: Bench, log: Log) -> None:
    options = EstimateOptions(starts=1, model="exact")
    first, other = log("plant=exact,seed=1"), log("plant=exact,seed=2,k_m=0.0225")
    study = make_study(bench, [first, other], options)
    assert study.checks.apart[0].name == "k_m"
    assert " ".join(apart(study).split()) in " ".join(study_text(study).split())
    for second in ("plant=exact,seed=2", "plant=stribeck,seed=2"):  # one brake, and one that the model does not know
        assert make_study(bench, [first, log(second)], options).checks.apart == ()


def test_a_nuisance_at_the_border_of_its_search_cuts_the_interval_of_a_parameter(bench: Bench, log: Log) -> None:
    study = make_study(bench, [log("plant=exact,seed=2")], EstimateOptions(nuisance="break_away,stribeck_velocity"))
    assert study["k_1"].finding.doubts == (Doubt.CUT,)
    (cut,) = (profile for profile in study.checks.profiles if profile.label == "k_1")
    assert DOUBTS[Doubt.CUT] in sentence(cut, study.estimate)
    (remedy,) = remedies(study, stopped=False)
    assert "break_away, stribeck_velocity" in remedy


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=pytest.mark.slow), 3])
@pytest.mark.parametrize("name", PARAMETER_NAMES)
def test_the_first_remedy_for_each_choice_of_parameters_is_a_command_that_gives_the_brake(
    bench: Bench, log: Log, replay: Replay, name: str, count: int
) -> None:
    """One parameter is 40 % larger than nominal; of the 14 proper subsets seven leave it fixed."""
    run = log(f"plant=exact,seed=3,{name}={1.4 * getattr(bench.brake, name)!r}")
    commands = set()
    for chosen in combinations(PARAMETER_NAMES, count):
        study = make_study(bench, [run], EstimateOptions(chosen, starts=1))
        assert all(c.interval[0] in (-np.inf, 0.0) or c.interval[0] > 0.0 for c in study.conclusions)
        assert verdict(study).holds == (name in chosen)
        if not verdict(study).holds:
            cause = study_document(study)["misfit"]["cause"]
            assert name in cause["fixed"]
            assert alarms(study.estimate)[0].startswith(
                ("one of " if len(cause["fixed"]) > 1 else "") + cause["fixed"][0]
            )
            assert cause["suspect"]["name"] == cause["fixed"][0]
            assert alarms(study.estimate)[0].endswith("estimate all four: leave --params out")
            commands.add(remedies(study, stopped=False)[0].partition(": ")[2])
    (command,) = commands
    found = replay.document(*shlex.split(command.removeprefix("emb-replay ")))
    assert found["model_fits"]
    assert all(row["interval_95"][0] <= row["true"] <= row["interval_95"][1] for row in found["parameters"].values())


def test_a_remedy_keeps_what_was_asked_for(bench: Bench, log: Log) -> None:
    run = log("plant=stribeck,f_v=3e-5,seed=2")
    for options, end in (
        (EstimateOptions("k_1", starts=1, model="exact"), " --model exact"),
        (EstimateOptions("k_1", method="pem", model="exact", starts=1), " --method pem --model exact"),
        (
            EstimateOptions("k_1", known=["k_1=23.04±1%"], model="exact", starts=1),
            " --known k_1=23.04±1% --model exact",
        ),
    ):
        study = make_study(bench, [run], options)
        assert remedies(study, stopped=False)[0] == f"estimate all four: emb-replay estimate {run.path}{end}"


@pytest.mark.parametrize(
    ("name", "inside", "beyond"),
    [
        ("k_1", (-0.99, 8.9), (-1.0, 9.1)),
        ("J", (-0.99, 8.9), (-3.0, 9.1)),
        ("T_c_drift", (-0.99, 0.99), (-3.06, 1.5)),
        ("delay", (-0.09, 3.5), (-0.2,)),
        ("velocity_gain", (-0.4, 0.4), (-1.2, 0.6)),
        ("x2_0", (-400.0, 400.0), (-800.0, 800.0)),
        ("quadratic", (-0.005, 0.09), (-0.02, 0.2)),
        ("play", (0.2, 9.0), (-0.1, 11.0)),
        ("break_away", (0.5,), (-0.1, 4.1)),
        ("velocity_lag", (1e-3,), (-1e-3, 0.2)),
    ],
)
def test_an_amount_is_possible_if_a_brake_can_have_it(
    bench: Bench, name: str, inside: tuple[float, ...], beyond: tuple[float, ...]
) -> None:
    low, high = possible(name, bench)
    assert all(low < amount < high for amount in inside)
    assert not any(low < amount < high for amount in beyond)


def test_every_effect_has_possible_amounts_on_both_sides_or_is_positive(bench: Bench) -> None:
    for name, row in EFFECTS.items():
        low, high = possible(name, bench)
        assert high > 0.0
        assert low == 0.0 if row.positive else low < 0.0


REMEDIES = {name: row.remedy.partition("--nuisance ")[2].partition(" ")[0] for name, row in EFFECTS.items()}


@pytest.mark.parametrize("plant", ["cubic", "hysteresis", "stribeck"])
def test_the_remedy_of_the_cause_gives_a_model_that_fits(plant: str, log: Log, replay: Replay) -> None:
    run = log(f"plant={plant},seed=7")
    first = replay.document("estimate", run.path, "--model", "exact")["misfit"]["cause"]["suspect"]["name"]
    names = REMEDIES[first].rstrip(",")
    said = replay.document("estimate", run.path, "--model", "exact", "--nuisance", names)
    assert said["model_fits"], names


@pytest.mark.parametrize("curve", ["quadratic = -2e-3", "cubic = -5e-5", "quadratic = 3e-3\ncubic = -8e-5"])
def test_a_clamp_that_becomes_softer_is_estimated_by_the_command_that_names_it(
    curve: str, tmp_path: Path, replay: Replay
) -> None:
    (file := tmp_path / "bench.toml").write_text(f"{shipped_bench_text()}\n[plants.softer]\n{curve}\n")
    run, true = tmp_path / "run.mcap", {"quadratic": 0.0, "cubic": 0.0} | tomllib.loads(curve)
    simulate_run(run, plant="softer", bench=file, seed=7)
    suspect = replay.document("estimate", run, "--model", "exact")["misfit"]["cause"]["suspect"]
    said = replay.document("estimate", run, "--model", "exact", "--nuisance", REMEDIES[suspect["name"]])
    assert said["model_fits"]
    for name, value in true.items():
        low, high = said["parameters"][name]["interval_95"]
        assert low < value < high, name


def test_every_nuisance_of_a_remedy_can_be_asked_for() -> None:
    assert {name: names for name, names in REMEDIES.items() if names}.keys() >= {"quadratic", "play", "drag", "f_l"}
    for names in filter(None, REMEDIES.values()):
        EstimationProblem(nuisances=tuple(names.rstrip(",").split(",")))


def test_profiles_with_all_priors_in_full_do_not_widen_averaged_intervals(bench: Bench, log: Log) -> None:
    run = log("plant=exact,seed=7")
    plain, profiled = (
        make_study(bench, [run], EstimateOptions(starts=1, profile=profile)) for profile in (False, True)
    )
    agreeing = [profile.label for profile in profiled.checks.profiles if profile.agrees]
    assert len(agreeing) >= 3
    assert [profiled[label].interval for label in agreeing] == [plain[label].interval for label in agreeing]


SMALL = 0.01  # Draws are smaller than the errors by this: to first order they are the same


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("clamping") / "run.mcap"
    api.simulate(made, plant="cubic", k_1=20.0, seed=3)
    return made


@pytest.fixture(scope="module")
def clamped(path: Path) -> Study:
    return api.estimate(path, nuisance="quadratic,cubic", starts=1)


def test_the_totals_are_those_of_draws_from_the_covariance_and_of_the_angle_s_scale(clamped: Study) -> None:
    e, rng, angle = clamped.estimate, np.random.default_rng(1), 40.0
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


def test_a_brake_is_told_at_the_largest_angle_that_it_clamped_to(clamped: Study) -> None:
    found, largest = clamped.clamping, float(clamped.estimate.experiments[0].samples[:, 0].max())
    assert found is not None
    assert 0.0 <= largest - found.angle < 1.1


def test_no_force_is_told_of_what_is_not_known(path: Path, tmp_path: Path) -> None:
    assert api.estimate(path, starts=1, model="exact").clamping is None, "the model does not fit"
    api.simulate(tmp_path / "nominal.mcap", plant="exact", seed=3)
    found = api.estimate(tmp_path / "nominal.mcap", starts=1, params="k_m,T_c,f_v")
    assert found.model_fits
    assert found.clamping is None, "k_1 is not estimated"


def test_text_document_and_page_tell_the_same(path: Path, clamped: Study, replay: Replay, tmp_path: Path) -> None:
    options = ("--nuisance", "quadratic,cubic", "--starts", "1")
    found = clamped.clamping
    assert found is not None
    said = " ".join(replay.text("estimate", path, *options).split())
    known = rf"clamping force known to 2(\.\d)? %: {found.force.value:.0f} ± \d+ N at {found.angle:.0f} rad, held by"
    assert re.search(known, said), said
    told = replay.document("estimate", path, *options)["clamping"]
    assert told["angle"] == found.angle
    assert told["force"] == {"value": found.force.value, "total": found.force.total, "unit": "N"}
    page = " ".join(make(tmp_path / "page.html", path, *options).reader.texts)
    assert f"Clamping force at {found.angle:.0f} rad from contact." in page
