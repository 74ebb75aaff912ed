"""``emb-replay report``: what the page says, in which order, and what it does not let through."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Callable
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from matplotlib.figure import Figure

from emb_bench import api
from emb_bench.analysis import stages
from emb_bench.analysis.options import EstimateOptions
from emb_bench.analysis.stages import make_study
from emb_bench.batch.evaluate import evaluate_one
from emb_bench.batch.row import CampaignOptions, Source
from emb_bench.batch.summary import campaign_text, summarise
from emb_bench.brake.parameters import quantity
from emb_bench.cli.replay import main
from emb_bench.config.bench import Bench
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.records import Unknown
from emb_bench.experiment.experiment import Experiment
from emb_bench.experiment.from_log import read_experiment
from emb_bench.figures import COLOURS
from emb_bench.logs.log import RunLog, read_log
from emb_bench.report import figures
from emb_bench.report.page import html
from emb_bench.report.report import Report as Made
from emb_bench.report.report import intervals, page_of, report_document, with_units
from emb_bench.report.sentences import MORE, effects
from emb_runtime.errors import EXIT_OUTSIDE, LogError
from emb_runtime.log.ring_buffer import Attachment, EventRecord
from emb_runtime.records import CycleRecord
from emb_runtime.safety.state_machine import FAULTS, Fault

from tests.bench.conftest import Replay  # isort: skip
from tests.bench.simulated_logs import square, write_log  # isort: skip
from tests.bench.report_pages import Report, make  # isort: skip
from tests.bench.experiment.test_experiment import Lose  # isort: skip
from tests.conftest import Simulate  # isort: skip
from tests.benches import SENSOR_TEXT

HOSTILE = "</style></title><script>alert(1)</script><img src=x onerror=alert(2)>\"'&amp;\x00\u202e"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("report")


@pytest.fixture(scope="module")
def good(folder: Path, simulate: Simulate) -> Path:
    return write_log(folder / "good.mcap", simulate(square, options="plant=exact,f_v=3e-5,seed=5"))


@pytest.fixture(scope="module")
def report(folder: Path, good: Path) -> Report:
    return make(folder / "good.html", good, "--starts", "2")


@pytest.fixture(scope="module")
def joint(folder: Path, good: Path, simulate: Simulate) -> Report:
    """Two runs of one brake, one of which lost samples, a file that is no log, and a run that never began."""
    lossy = simulate(square, options="plant=exact,f_v=3e-5,seed=6", on_receive=Lose(120, 121, 300))
    other = write_log(folder / "other.mcap", lossy)
    never = write_log(folder / "never.mcap", simulate(square, options="plant=exact", stop_requested=lambda: True))
    broken = folder / "broken.mcap"
    broken.write_bytes(b"no log at all")
    arguments = ("--nuisance", "x1_0", "--starts", "1")
    return make(folder / "joint.html", good, broken, other, never, *arguments, code=1)


@pytest.mark.parametrize(
    ("options", "model", "code", "verdicts", "differs"),
    [
        ("plant=exact,f_v=3e-5,seed=8", "exact", 0, ("fits", "fits"), set()),
        ("plant=exact,f_v=3.6e-5,seed=8", "exact", 0, ("fits", "fits"), {"f_v"}),
        ("plant=stribeck,f_v=3e-5,seed=8", "exact", 1, ("fits", "DOES NOT FIT"), None),
    ],
)
def test_two_runs_stand_side_by_side_each_by_itself(
    tmp_path: Path,
    good: Path,
    simulate: Simulate,
    options: str,
    model: str,
    code: int,
    verdicts: tuple[str, str],
    differs: set[str] | None,
) -> None:
    other = write_log(tmp_path / "other.mcap", simulate(square, options=options))
    given = ("--compare", "--strict", "--model", model, "--starts", "1")
    made = make(tmp_path / "page.html", good, other, *given, code=code)
    text, document = made.reader.text, made.numbers
    assert all(f"{log.name}: {said}" in text for log, said in zip((good, other), verdicts, strict=True))
    assert document["estimate"] is None
    for path, run in zip((good, other), document["runs"], strict=True):
        alone = make(tmp_path / "alone.html", path, *given[2:]).numbers["estimate"]
        found = [(c["value"], c["interval"]) for c in run["alone"]["conclusions"]]
        assert found == [(c["value"], c["interval_95"]) for c in alone["parameters"].values()]
    changes = {d["name"]: d for d in document["compared"]}
    assert list(changes) == ["k_m", "k_1", "T_c", "f_v"]
    values = [[c["value"] for c in run["alone"]["conclusions"]] for run in document["runs"]]
    assert values == [[d[when] for d in changes.values()] for when in ("last", "now")]
    if differs is not None:
        assert {name for name, d in changes.items() if d["drifted"]} == differs
        assert ("No parameter differs significantly" in text) == (not differs)


def test_a_run_without_an_estimate_is_compared_with_none(tmp_path: Path, good: Path, simulate: Simulate) -> None:
    never = write_log(tmp_path / "never.mcap", simulate(square, options="plant=exact", stop_requested=lambda: True))
    with pytest.raises(LogError, match=r"--compare: never\.mcap has no estimate"):
        api.report([good, never], tmp_path / "page.html", compare=True)
    assert not (tmp_path / "page.html").exists()


def test_the_report_says_what_a_loss_of_all_commands_would_do(folder: Path, simulate: Simulate) -> None:
    lets_go = SENSOR_TEXT.replace('stop             = "damped"', 'stop             = "freewheel"')
    bench = Attachment("bench.toml", "application/toml", lets_go.encode())
    path = write_log(folder / "loose.mcap", simulate(square, options="plant=exact"), attachments=[bench])
    loose = " ".join(make(folder / "loose.html", path, "--starts", "1").reader.texts)
    said = r"the node switches the current off, and a brake of the set may hit an end stop with (\S+) × 10³ rad/s"
    speed = re.search(said, loose)
    assert speed is not None
    assert 0.965 < float(speed[1]) < 1.5  # a bound: research by simulation found 965 rad/s


REAL: dict[str, Any] = {"metadata": {"emb.run": {"steps": "500", "iface": "can0"}}}
VIRTUAL: dict[str, Any] = {"metadata": {"emb.run": {"steps": "500", "iface": "vcan0"}}}


@pytest.mark.parametrize(
    ("logs", "said"),
    [
        ([REAL], ""),
        ([{}], "SIMULATED: the values are of a simulated brake, not of a real machine."),
        ([VIRTUAL], "SIMULATED: the values are of a node on a virtual bus (vcan0), not of a real machine."),
        ([REAL, {}], "SIMULATED: the values are of a simulated brake in 1 of 2 runs (1.mcap), not of a real machine."),
        (
            [{}, VIRTUAL],
            "SIMULATED: the values are of a simulated brake and a node on a virtual bus (vcan0), not of a real "
            "machine.",
        ),
    ],
)
def test_what_is_not_of_a_real_machine_is_marked_on_every_sheet_and_in_every_command(
    tmp_path: Path, simulate: Simulate, replay: Replay, logs: list[dict[str, Any]], said: str
) -> None:
    paths = [
        write_log(tmp_path / f"{n}.mcap", simulate(square, options=f"plant=exact,seed={n + 1}"), **changes)
        for n, changes in enumerate(logs)
    ]
    estimate = replay.text("estimate", *paths, "--model", "exact", "--starts", "1")
    assert " ".join(estimate.split()).startswith(said or "The model")
    assert replay.document("estimate", *paths, "--model", "exact", "--starts", "1")["simulated"] == bool(said)
    for path, changes in zip(paths, logs, strict=True):
        assert ("SIMULATED" in replay.text("info", path)) == (changes is not REAL)
        assert replay.document("info", path)["simulated"] == (changes is not REAL)
    marked = sum(changes is not REAL for changes in logs)
    options = ("-o", tmp_path / "rows.csv", "--method", "none", "--jobs", "1")
    of_campaign = replay.text("campaign", *paths, *options)
    assert ("SIMULATED" in of_campaign) == bool(said)
    if said:
        assert f"SIMULATED: {marked} of {len(logs)} logs are not of a real machine" in of_campaign
    page = make(tmp_path / "page.html", *paths, "--model", "exact", "--starts", "1")
    html = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert page.numbers["simulated"] == bool(said)
    assert page.reader.texts[0].startswith(said or "The model 'exact' fits.")
    assert (page.reader.headings[0].startswith("SIMULATED"), "<title>SIMULATED" in html) == (bool(said), bool(said))
    assert ('@top-left { content: "SIMULATED: Report' in html) == bool(said)  # the head of each sheet
    tone = re.search(r'class="banner (\w+)"', html)
    assert tone is not None
    assert tone[1] == ("care" if said else "good")


def test_a_run_of_a_few_samples_is_reported_without_an_estimate(
    folder: Path, simulate: Simulate, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_log(folder / "four.mcap", simulate(square, options="plant=exact", steps=4))
    made = make(folder / "short.html", path, code=1)
    why = made.numbers["why_no_estimate"]
    assert why in " ".join(made.reader.text.split())
    assert made.numbers["estimate"] is None
    capsys.readouterr()
    assert main(["estimate", str(path)]) == 6
    assert why in capsys.readouterr().err


@pytest.mark.slow
def test_residuals_are_those_whose_squares_are_the_deviance_and_the_angle_is_the_log_s(
    report: Report, good: Path
) -> None:
    run = report.numbers["runs"][0]
    errors = np.array([run["residuals"][name] for name in ("angle", "velocity")])
    assert (errors**2).sum() == pytest.approx(report.numbers["estimate"]["misfit"]["chi2"])
    assert run["experiment"]["angle"] == read_experiment(read_log(good)).all_samples[:, 0].tolist()


def test_links_lead_somewhere_and_names_are_unique(report: Report, joint: Report) -> None:
    for made in (report, joint):
        names = made.reader.values("id")
        assert len(set(names)) == len(names)
        links = made.reader.values("href")
        assert links
        assert all(link.startswith("#") and link[1:] in names for link in links)


def test_every_figure_says_what_it_shows(report: Report) -> None:
    says = report.reader.values("alt")
    assert len(says) == report.reader.tags.count("img") >= 5
    assert all(len(text) > 30 for text in says)


def test_the_page_needs_nothing_but_itself(report: Report, joint: Report) -> None:
    for made, most in ((report, 1.5e6), (joint, 3e6)):
        assert len(made.html) < most
        assert not {"script", "link", "iframe", "object", "embed", "form", "base"} & set(made.reader.tags)
        assert all(source.startswith("data:image/svg+xml;base64,") for source in made.reader.values("src"))
        assert not re.search(r"url\(|@import", made.html)
        assert not [name for _, name, _ in made.reader.attributes if name.startswith("on")]
        policy = dict(part.strip().split(" ", 1) for part in made.reader.values("content")[0].split(";"))
        assert (policy["default-src"], policy["img-src"]) == ("'none'", "data:")
        assert set(policy) == {"default-src", "style-src", "img-src", "base-uri", "form-action"}


def test_a_report_reads_each_experiment_once(
    folder: Path, bench: Bench, good: Path, joint: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[str] = []

    def counted(log: RunLog, *more: Any) -> Experiment:
        seen.append(log.path.name)
        return read_experiment(log, *more)

    monkeypatch.setattr(stages, "read_experiment", counted)
    made = gathered(bench, good, folder / "other.mcap")
    assert [run.alone is not None for run in made.study.runs] == [True, True]
    assert seen == [good.name, "other.mcap"]


def test_the_numbers_are_those_of_the_command_estimate(report: Report, good: Path, replay: Replay) -> None:
    said = replay.document("estimate", good, "--starts", "2", "--profile")
    assert {"schema": said["schema"], **report.numbers["estimate"]} == said


def test_the_pale_line_of_a_profile_is_the_parabola_of_the_fisher_information(
    good: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = read_log(good)
    study = make_study(log.bench, [log], EstimateOptions(profile=True))
    e = study.estimate
    assert (e.deviations()[:4] > 1.01 * e.cramer_rao()[:4]).all()  # the model's uncertainty is in the former
    drawn: list[Any] = []

    def keep(draw: Callable[[Any], None], rows: int, columns: int, size: tuple[float, float]) -> bytes:
        axes = Figure(size).subplots(rows, columns, squeeze=False)
        draw(axes)
        drawn.extend(axes.flat)
        return b""

    monkeypatch.setattr(figures, "svg", keep)
    figures.profiles(study.checks.profiles, e)
    for profile, axis in zip(study.checks.profiles, drawn, strict=False):
        (line,) = [line for line in axis.lines if line.get_color() == COLOURS[4]]
        unit = 1e6 if "ppm" in axis.get_xlabel() else 100.0
        bound = unit * e.cramer_rao()[e.labels.index(profile.label)]
        np.testing.assert_allclose(line.get_ydata(), (line.get_xdata() / bound) ** 2)


def test_every_effect_of_the_tests_and_of_the_budget_is_explained_on_the_page_in_one_line(report: Report) -> None:
    study = report.numbers["estimate"]
    words = report.reader.text.partition("Terms")[2]
    named = {s["name"] for s in study["misfit"]["suspects"]} | {b["name"] for b in study["misfit"]["budget"]}
    assert {"play", "f_l", "contact", "hysteresis", "T_c_drift", "angle_scale"} <= named
    for name in named:
        assert f" {name.replace('_scale', ' scale')} " in words, name
    assert all(said and not said.endswith(",") for said in effects(None).values())


def test_metadata_has_four_digits_and_units(report: Report) -> None:
    assert with_units({"top_speed": "491.30350000000004", "limit": "6.0", "T_c": "0.01037", "steps": "500"}) == [
        ("top_speed", "491.3 rad/s"), ("limit", "6 A"), ("T_c", "0.01037 N·m"), ("steps", "500"),
    ]  # fmt: skip
    hostile = {"top_speed": "fast", "limit": "nan", "tool": "emb-excite 0.2.0", "unexplained": "3.28157663208528"}
    assert [text for _, text in with_units(hostile)] == ["fast", "– A", "emb-excite 0.2.0", "3.282 rad/s"]
    names = {"device_serial": "2024.0150", "operator": "1.50", "bench_name": "3.0"}
    assert dict(with_units(names)) == names
    assert "6 A" in report.reader.texts


@pytest.mark.parametrize(
    ("unknown", "farthest", "expected"),
    [
        ("k_m", 2e-7, (1e6 / 0.02, "ppm")),
        ("k_m", 2e-3, (100.0 / 0.02, "%")),
        ("offset", 0.2, (1.0, "rad")),
        ("offset", 2e-4, (1e4, "10⁻⁴ rad")),
        ("velocity_gain", 2e-4, (1e4, "10⁻⁴")),
        ("offset", 0.0, (1.0, "rad")),
    ],
)
def test_an_axis_of_a_profile_needs_no_power_of_ten(unknown: str, farthest: float, expected: tuple[float, str]) -> None:
    e = SimpleNamespace(unknowns=[Unknown(unknown)], scale=np.array([0.02]), quantities=[quantity(None, unknown)])
    factor, unit = figures.axis_unit(cast("Estimate", e), 0, farthest)
    assert factor == pytest.approx(expected[0])
    assert unit == expected[1]


def test_without_systematic_errors_nothing_says_that_they_are_in_the_total(
    folder: Path, good: Path, replay: Replay
) -> None:
    options = ("--systematic", "none", "--starts", "1")
    made = make(folder / "noise.html", good, *options)
    verdict = made.reader.text.partition("Terms")[0]
    for said in (verdict, replay.text("estimate", good, *options), replay.text("estimate", good, *options, "-v")):
        flat = " ".join(said.split())
        assert "by sensor noise alone" in flat
        assert "also systematic errors" not in flat
        assert "Uncertainty budget" not in flat
        assert "limited by" not in flat


def test_what_was_left_out_or_is_missing_comes_before_the_verdict(joint: Report) -> None:
    text = joint.reader.text
    verdict = text.index("Verdict")
    assert text.index("broken.mcap: left out: not an MCAP file") < verdict
    assert text.index("never.mcap: not used in the estimate: no experiment in this log") < verdict
    assert joint.numbers["left_out"][0]["why"].startswith("not an MCAP file")
    assert "3 samples were lost" in text
    lost = joint.numbers["runs"][1]
    assert lost["residuals"]["angle"].count(None) == 3
    assert lost["experiment"]["measured"] == 497


def gathered(bench: Bench, *paths: Path) -> Made:
    """What a report would say, without the figures."""
    options = EstimateOptions(starts=1)
    return Made(make_study(bench, [read_log(path) for path in paths], options, for_report=True), bench, [], "x")


def test_a_further_run_is_named_where_a_parameter_is_not_identified_and_none_was_stopped(
    folder: Path, bench: Bench, simulate: Simulate
) -> None:
    pages = []
    for fails_at in (math.inf, 40):
        run = simulate(lambda _a, _v, k, at=fails_at: math.nan if k >= at else 0.02, options="plant=exact", steps=60)
        path = write_log(folder / f"stands-{fails_at}.mcap", run, steps=60)
        pages.append(html(page_of(gathered(bench, path))))
    assert [MORE[1:] in page for page in pages] == [True, False]


def test_what_a_log_says_does_not_become_markup(folder: Path, simulate: Simulate) -> None:
    run = simulate(square, options="plant=exact", stop_requested=lambda: True)
    when = run.journal.events[-1].time_ns
    run.journal.records += [EventRecord(when, HOSTILE, HOSTILE)]
    path = folder / "<script>alert(3)<"  # as the name of a folder
    path.mkdir()
    log = write_log(
        path / "<img src=x onerror=alert(4)>.mcap",
        run,
        metadata={"emb.run": {"iface": HOSTILE, HOSTILE: HOSTILE}, HOSTILE: {HOSTILE: "x" * 10_000}},
        attachments=[Attachment(HOSTILE, "text/plain", b"")],
    )
    bench = folder / "bench.toml"
    assert main(["info", str(log)]) == 0
    bench.write_text(SENSOR_TEXT, encoding="utf-8")
    made = make(folder / "hostile.html", log, "--bench", bench, code=1)
    assert not {"script", "link", "iframe"} & set(made.reader.tags)
    assert made.reader.tags.count("style") == made.reader.tags.count("title") == 1
    assert "img" not in made.reader.tags
    assert {name for _, name, _ in made.reader.attributes} <= {
        *("lang", "charset", "http-equiv", "content", "name", "id", "class", "role", "href", "scope", "tabindex"),
        "aria-label",
        "data-column",
    }
    shown = HOSTILE.replace("\x00", "\\x00").replace("\u202e", "\\u202e")
    assert made.reader.text.count(" ".join(shown.split())) >= 5
    assert "8000 further characters" in made.reader.text
    assert made.numbers["runs"][0]["info"]["metadata"]["emb.run"]["iface"] == HOSTILE


def test_a_difference_between_sent_and_applied_current_is_drawn(joint: Report) -> None:
    """Of the two runs, the one that lost samples braked meanwhile."""
    assert joint.reader.text.count("The node applied the sent current in every period.") == 1


def test_real_time_is_in_the_table(folder: Path, bench: Bench, simulate: Simulate) -> None:
    run = simulate(square, options="plant=exact", steps=60)
    number, records = count(), run.journal.records
    records[:] = [
        r._replace(send_time_ns=r.receive_time_ns + 7_000 * (next(number) % 50) + 1)
        if isinstance(r, CycleRecord)
        else r
        for r in records
    ]
    metadata = {"emb.run": {"steps": "60", "iface": "can0"}}
    real = gathered(bench, write_log(folder / "real.mcap", run, steps=60, metadata=metadata))
    punctual = real.study.runs[0].timing
    assert punctual is not None
    table = intervals(punctual)
    assert table is not None
    assert "343 µs" in [cell for row in table.rows for cell in row]
    page = html(page_of(real))
    assert "bench on can0" in page
    assert "Time was simulated" not in page
    assert report_document(real)["runs"][0]["timing"]["intervals"]["response"]["p100"] == pytest.approx(343.001e-6)


def test_a_report_replaces_a_report_but_never_what_it_reads(folder: Path, good: Path, replay: Replay) -> None:
    here = folder / "again"
    here.mkdir()
    never, log, page = folder / "never.mcap", here / "log.html", here / "page.html"
    shutil.copy(never if never.exists() else good, log)
    assert "would write over" in replay.refused("report", log, "-o", log)
    (here / "page.json").write_text("{}", encoding="utf-8")
    assert "would write over" in replay.refused("report", good, "--last", here / "page.json", "-o", page)
    page.write_text("the last one", encoding="utf-8")
    make(page, log, code=int(never.exists()))
    assert sorted(path.name for path in here.iterdir()) == ["log.html", "page.html", "page.json"]


def test_an_experiment_that_was_cut_short_has_a_cause_and_no_values(
    folder: Path, simulate: Simulate, replay: Replay
) -> None:
    run = simulate(lambda a, v, k: math.nan if k >= 120 else square(a, v, k), options="plant=exact,seed=5")
    path = write_log(folder / "cut.mcap", run)
    made = make(folder / "cut.html", path, "--starts", "1")
    assert FAULTS[Fault.POLICY_NOT_FINITE].cause in made.reader.text
    assert not {"Parameters", "What to do next", "Uncertainty"} & set(made.reader.headings)
    assert len(made.reader.values("alt")) >= 3
    assert "k_m" in replay.text("estimate", path, "--starts", "1", "-v")


def test_a_brake_outside_of_the_shield_s_ranges_is_said_everywhere(
    folder: Path, bench: Bench, simulate: Simulate, replay: Replay
) -> None:
    ranges = bench.range_set(bench.shield.ranges)
    path = write_log(folder / "stiff.mcap", simulate(square, options=f"plant=exact,k_1={1.5 * ranges.high.k_1}"))
    text = replay.text("estimate", path, "--starts", "1", "--strict", code=EXIT_OUTSIDE)
    assert text.startswith("OUTSIDE: k_1")
    found = replay.document("estimate", path, "--starts", "1")["parameters"]
    assert {name: c["outside"] for name, c in found.items() if c["outside"]} == {
        "k_1": [ranges.low.k_1, ranges.high.k_1]
    }
    made = make(folder / "stiff.html", path, "--starts", "1", "--strict", code=EXIT_OUTSIDE)
    assert any(line.startswith("OUTSIDE: k_1") for line in made.reader.texts[:4])
    row = evaluate_one(Source(str(path), "", path.name, "."), CampaignOptions(starts=1))
    assert "OUTSIDE: stiff.mcap: k_1" in campaign_text(summarise([row], CampaignOptions(), "rows.csv"))
