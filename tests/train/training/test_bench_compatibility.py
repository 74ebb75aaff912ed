"""For which bench an actor is, and what is said where it is for another one."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from emb_runtime.config.bench import Bench, load_bench, parse_bench, shipped_bench_text
from emb_runtime.errors import UsageError
from emb_runtime.safety.shield_design import make_law
from emb_train.cli.train import main
from emb_train.envs.conditions import Conditions
from emb_train.presets import load_preset
from emb_train.training.bench_compatibility import require_alike, require_fit, shield_changes, unfit

BENCH = load_bench()
MADE = parse_bench(
    shipped_bench_text()
    .replace("k_1   = 2.304e1 ", "k_1   = 37.5 ")
    .replace('ranges        = "envelope"', 'ranges        = "viscous-stiffness"'),
    "made",
)


@pytest.mark.parametrize("name", ["viscous", "pm50", "envelope", "nominal"])
def test_what_the_shield_covers_fits(name: str) -> None:
    ranges = BENCH.range_set(name)
    assert unfit(BENCH, ranges) == ""
    require_fit(BENCH, ranges, "it")


def test_what_it_does_not_cover_is_told_with_the_lines_of_a_bench_file_that_does() -> None:
    ranges = BENCH.range_set("viscous-stiffness")
    said = unfit(BENCH, ranges)
    assert "brakes with k_1 from 25 to 50, and the bench's shield covers k_1 from 11.52 to 34.56" in said
    assert 'write k_1 = 37.5 in [brake] and ranges = "viscous-stiffness" in [shield]' in said
    with pytest.raises(UsageError):
        require_fit(BENCH, ranges, "it")
    assert unfit(MADE, ranges) == ""
    make_law(MADE)  # and there is a shield for it


def changed(part: str, **to: object) -> Bench:
    return dataclasses.replace(BENCH, **{part: dataclasses.replace(getattr(BENCH, part), **to)})


def test_a_bench_is_alike_that_differs_in_its_shield_and_in_the_middle_of_its_ranges() -> None:
    require_alike(BENCH, MADE, "it")
    require_alike(BENCH, changed("shield", frame_age=(0, 2)), "it")


def test_a_bench_is_not_alike_that_differs_in_what_an_actor_knows() -> None:
    for other in (
        changed("limits", current=5.0),
        changed("limits", angle=(-5.0, 100.0)),
        changed("noise", angle=0.5),
        changed("timing", horizon=400),
        dataclasses.replace(BENCH, brake=BENCH.brake._replace(J=1e-6)),
        dataclasses.replace(BENCH, brake=BENCH.brake._replace(gamma=1e-5)),
    ):
        with pytest.raises(UsageError):
            require_alike(BENCH, other, "it")


def test_shields_differ_by_what_they_cover_and_not_by_what_it_is_called() -> None:
    renamed = dataclasses.replace(BENCH, ranges={**BENCH.ranges, "same": BENCH.range_set("envelope")})
    assert shield_changes(BENCH, changed("shield", ranges="pm50")) == "ranges envelope, here pm50"
    assert shield_changes(renamed, dataclasses.replace(renamed, shield=changed("shield", ranges="same").shield)) == ""
    late = changed("shield", frame_age=(0, 2), current_lag=0.002)
    assert shield_changes(BENCH, late) == "frame_age (0, 0), here (0, 2), current_lag 0.0, here 0.002"


def test_a_training_for_another_bench_says_so_before_it_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("emb_train.training.loop.train", lambda *_: None)
    monkeypatch.setattr("emb_train.cli.train._ended", lambda *_: "")
    other = dataclasses.replace(load_preset("single-viscous"), ranges="viscous-stiffness", parameters=("k_1", "f_v"))
    other = dataclasses.replace(other, conditions=Conditions(shield_ranges="viscous-stiffness"))
    for preset, lines in ((load_preset("single-viscous"), 0), (other, 1)):
        monkeypatch.setattr("emb_train.cli.train.load_preset", lambda _, preset=preset: preset)
        assert main(["--preset", "it", "--out", str(tmp_path / str(lines))]) == 0
        assert capsys.readouterr().err.count("\n") == lines
