"""``python -m studies.comparison``: what it writes, and how it says no."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emb_bench.cli.design import main as emb_design
from emb_bench.excitation.reference import EXCITATIONS, parse_excitation
from emb_runtime.config.bench import PARAMETER_NAMES, load_bench, parse_bench, shipped_bench_text
from emb_runtime.errors import UsageError
from emb_runtime.policy.policy import shipped_actor_path
from studies.comparison.candidates import optimal, read_candidates
from studies.comparison.cli import choices, main
from studies.comparison.comparison import ComparisonPlan

from tests.bench.processes import left_of, press_ctrl_c, processes, started  # isort: skip

SMALL = ["--brakes", "2", "--draws", "1", "--ranges", "viscous"]


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str | Path, code: int = 2) -> str:
    assert main([*map(str, arguments)]) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("python -m studies.comparison: ")
    return err


@pytest.fixture(scope="module")
def design(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Currents of 1 A as a design of the shipped bench."""
    path = tmp_path_factory.mktemp("design") / "mine.npz"
    write_design(path)
    return path


def write_design(path: Path, current: Any = None, **changes: Any) -> None:
    bench = load_bench()
    metadata = {"contract_hash": bench.contract_hash, "criterion": "E", **changes}
    currents = np.append(np.ones(bench.timing.horizon), 0.0) if current is None else current
    np.savez_compressed(path, current=currents, metadata=np.array(json.dumps(metadata)))


def test_the_numbers_are_the_same_whatever_the_number_of_processes(
    design: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    who = ["actor", str(design), "step:amplitude=1"]
    assert main([*who, *SMALL, "--json", "--jobs", "1"]) == 0
    one, said = capsys.readouterr()
    assert said.count("\n") == 1
    out = tmp_path / "new" / "folder"
    assert main([*who, *SMALL, "--json", "--jobs", "2", "-o", str(out)]) == 0
    two = capsys.readouterr().out
    assert one == two
    found = json.loads(one)
    assert [c["name"] for c in found["contestants"]] == ["actor", "mine.npz", "step:amplitude=1"]
    mine, step = (found["plants"]["exact"][name] for name in ("mine.npz", "step:amplitude=1"))
    assert mine == step  # the same currents, the same brakes, the same noise
    ours = next(pair for pair in found["pairs"] if pair["other"] == "mine.npz")
    assert ours["parameter"] == "f_v"
    assert found["params"] == ["f_v"]

    written = json.loads((out / "comparison.json").read_text())
    assert {key: written[key] for key in found} == found
    assert written["command"].startswith("python -m studies.comparison actor ")
    assert written["command"].endswith("--ranges viscous --plant exact --model exact --params f_v --known 0 --seed 0")
    page = (out / "comparison.md").read_text()
    assert written["command"] in page
    assert "Is the learned excitation worth it, for f_v" in page
    assert (out / "comparison.png").read_bytes().startswith(b"\x89PNG")


def test_another_seed_is_another_comparison(capsys: pytest.CaptureFixture[str]) -> None:
    euler = ["--plant", "euler", "--model", "euler", "--jobs", "1"]
    assert main(["step", "ramp", *SMALL, *euler, "--seed", "1"]) == 0
    said = capsys.readouterr().out
    assert "seed 1" in said
    assert "step against ramp: " in said
    assert "worth it" not in said  # nothing here was learned
    assert max(map(len, said.splitlines())) <= 120


def test_a_design_plays_what_emb_design_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench, out = tmp_path / "short.toml", tmp_path / "best.npz"
    bench.write_text(shipped_bench_text().replace("horizon     = 500", "horizon     = 50"), encoding="utf-8")
    quick = ["--starts", "1", "--params", "k_m,T_c", "--model", "euler"]
    assert emb_design(["--bench", str(bench), *quick, "--out", str(out)]) == 0
    capsys.readouterr()
    (made,) = read_candidates([str(out)], load_bench(bench), ())
    with np.load(out) as file:
        expected = file["current"][:-1]
    played = made.built(load_bench(bench))
    assert [played.act(0.0, 0.0, k, 0.0) for k in range(50)] == expected.tolist()
    assert made.origin.startswith("D-optimal design")
    assert "made for another bench" in refusal(capsys, out, "step", *SMALL)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nope"], "'nope' is no excitation: expected actor, optimal, constant-speed"),
        (["chirp:f9=1"], "chirp: no parameter 'f9'"),
        (["step:amplitude=60"], "step: amplitude: expected a number from -6 to 6 A"),
        (["step", "step"], "'step' is named twice"),
        (["missing.onnx"], "missing.onnx: cannot read the policy file"),
        (["missing.npz"], "missing.npz: cannot read the design"),
        (["step", "--brakes", "1"], "--brakes: expected a number from 2, got 1"),
        (["step", "--draws", "0"], "--draws: expected a number from 1, got 0"),
        (["step", "--jobs", "0"], "--jobs: expected a number from 1, got 0"),
        (["step", "--seed", "-1"], "--seed: expected a number from 0, got -1"),
        (["step", "--known", "-1"], "--known: expected a number from 0, got -1"),
        (["step", "--ranges", "nope"], "nope"),
        (["step", "--plant", "nope"], "nope"),
        (["step", "--model", "observer"], "'observer' has instruments"),
        (["step", "--params", "f_v"], "k_m, k_1, T_c varies in the ranges 'envelope'"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said in refusal(capsys, *arguments)


def test_an_actor_of_another_bench_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench = tmp_path / "other.toml"
    bench.write_text(shipped_bench_text().replace("current  = 6.0", "current  = 5.0"), encoding="utf-8")
    assert "bench" in refusal(capsys, "actor", "--bench", bench, code=5)
    damaged = tmp_path / "damaged.onnx"
    damaged.write_bytes(shipped_actor_path().read_bytes()[:5000])
    assert "not ONNX, or cut short" in refusal(capsys, damaged, "step", code=5)


def test_a_file_that_is_no_design_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bad.npz"
    good = tmp_path / "good.npz"
    write_design(good)
    for content in (b"", b"PK\x03\x04 nothing", good.read_bytes()[:200], b"\x93NUMPY"):
        path.write_bytes(content)
        assert "expected a design that emb-design --out wrote" in refusal(capsys, path)
    np.savez(path, other=np.ones(3))
    assert "expected a design" in refusal(capsys, path)
    np.savez(path, current=np.ones(501), metadata=np.array("[1]"))
    assert "expected a design" in refusal(capsys, path)
    write_design(path, current=np.ones(7))
    assert "expected 501 finite currents, got shape (7,)" in refusal(capsys, path)
    write_design(path, current=np.full(501, np.nan))
    assert "expected 501 finite currents" in refusal(capsys, path)
    write_design(path, contract_hash="0")
    assert "made for another bench" in refusal(capsys, path)


def test_two_files_of_one_name_are_refused(design: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    again = tmp_path / design.name
    again.write_bytes(design.read_bytes())
    assert "two files have the same name" in refusal(capsys, design, again)


def test_a_place_that_cannot_be_written_to_is_said_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = tmp_path / "taken"
    taken.write_text("")
    file = refusal(capsys, "step", *SMALL, "-o", tmp_path / "x.md")
    assert "expected a folder, and a name with an ending is a file's" in file
    assert not (tmp_path / "x.md").exists()
    assert "cannot be a folder to write to" in refusal(capsys, "step", *SMALL, "-o", taken)


@pytest.mark.parametrize("first", ["step", "optimal"])
@pytest.mark.slow
def test_ctrl_c_ends_every_process_writes_nothing_and_says_so_in_one_line(first: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    many = ["--brakes", "500", "--draws", "20", "--jobs", "2", "-o", str(out)]
    running = started([sys.executable, "-m", "studies.comparison", first, "ramp", *many])
    assert running.stderr is not None
    if first == "step":
        assert (
            running.stderr.readline()
            == "python -m studies.comparison: 2 excitations on 500 brakes, 20 draws each, 2 processes\n"
        )
    while not any("spawn_main" in name for name in processes(running.pid).values()):
        assert running.poll() is None
    code, said, complaint = press_ctrl_c(running)
    assert (code, said, complaint) == (130, "", "python -m studies.comparison: interrupted, nothing written\n")
    assert list(out.iterdir()) == []
    assert left_of(running.pid) == {}


@pytest.mark.slow
def test_the_optimum_is_the_same_from_a_process_of_its_own() -> None:
    short = parse_bench(shipped_bench_text().replace("horizon     = 500", "horizon     = 40"), "test")
    (found,) = read_candidates(["optimal"], short, ("k_m", "f_v"))
    expected = optimal(short, ("k_m", "f_v"))
    assert (found.name, found.origin) == (expected.name, expected.origin)
    assert found.currents is not None
    np.testing.assert_array_equal(found.currents, expected.currents)


def test_help_names_every_excitation_as_it_is_when_nothing_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    bench = load_bench()
    with pytest.raises(SystemExit):
        main(["--help"])
    lines = capsys.readouterr().out.splitlines()
    for name in EXCITATIONS:
        (line,) = [line for line in lines if line.split()[:1] == [name]]
        for taken, value in parse_excitation(name, bench).parameters.items():
            assert f" {taken}={value:g}" in line
    assert "  chirp           amplitude=3 A, f0=1 Hz, f1=50 Hz" in lines
    for name in bench.ranges:
        assert any(name in line.replace(",", "").split() for line in lines)


def test_a_plant_is_in_the_help_if_it_can_be_played() -> None:
    bench = load_bench()
    words = choices(bench).replace(",", "").split()
    for name in bench.plants:
        try:
            ComparisonPlan(PARAMETER_NAMES, "envelope", (name,), name, 2, 1, 0, 0).check(bench)
            assert name in words
        except UsageError:
            assert name not in words
