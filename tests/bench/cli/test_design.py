"""``emb-design``: what it writes, and what is no design of a bench."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from emb_bench.cli.design import main
from emb_bench.config.bench import load_bench
from emb_bench.design.report import read_design
from emb_bench.experiment.experiment import planned
from emb_bench.experiment.simulate import Theta, simulate
from emb_runtime.errors import EXIT_INTERRUPTED, UsageError

from tests.bench.flows import fisher  # isort: skip
from tests.benches import SENSOR_TEXT

PERIODS = 50
QUICK = ["--criterion", "D", "--starts", "1", "--params", "k_m,T_c", "--model", "euler"]


@pytest.fixture
def short(tmp_path: Path) -> Path:
    """A bench with a sensor of the velocity and a short experiment."""
    path = tmp_path / "short.toml"
    text = SENSOR_TEXT.replace("horizon     = 500", f"horizon     = {PERIODS}")
    path.write_text(text, encoding="utf-8")
    return path


def test_the_file_holds_a_design_that_can_be_simulated_again(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, theta = tmp_path / "design.csv", tmp_path / "estimate.json"
    theta.write_text('{"parameters": {"f_v": 3e-5}}')
    assert main(["--bench", str(short), *QUICK, "--theta", str(theta), "--seed", "4", "--output", str(out)]) == 0
    assert "limits kept, home" in capsys.readouterr().out
    bench, (head, *rest) = load_bench(short), out.read_text(encoding="utf-8").splitlines()
    metadata = json.loads(head.removeprefix("# "))
    time, current, angle, velocity = np.array([[float(v) for v in row] for row in list(csv.reader(rest))[1:]]).T
    brake = bench.brake._replace(f_v=3e-5)
    assert metadata["theta"] == brake._asdict()
    assert (metadata["seed"], metadata["starts"], metadata["model"]) == (4, 1, "euler")
    assert metadata["version"]
    plant = bench.plant("euler")
    run = simulate(plant, Theta(brake), planned(current[:-1]), 1e-3)
    np.testing.assert_allclose(np.column_stack([angle, velocity]), run.states, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(time, 1e-3 * np.arange(PERIODS + 1))
    again = fisher(bench, brake, current[:-1], kind="physical", plant=plant, params=metadata["params"])
    assert again.criteria().log_det == pytest.approx(metadata["value"], rel=1e-9)
    own = metadata["checks"][0]
    assert (own["plant"], own["limits_held"], own["home"]) == ("euler", True, True)
    assert read_design(out, bench)[0].tolist() == current[:-1].tolist()


@pytest.mark.parametrize("told", ["--bench", "--model"])
def test_behind_an_observer_a_design_is_of_the_angle_alone(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], told: str
) -> None:
    """Of one that the bench declares, and of a plant's own."""
    if told == "--bench":
        text = short.read_text(encoding="utf-8")
        short.write_text(f'{text}\n[sensors]\nvelocity = "observer"\nobserver_bandwidth = 800\n', encoding="utf-8")
    out, model = tmp_path / "design.csv", "exact" if told == "--bench" else "observer"
    more = ["--criterion", "D", "--starts", "1", "--params", "k_m,T_c", "--model", model, "--output", str(out)]
    assert main(["--bench", str(short), *more]) == 0
    assert "physical information of the angle alone" in capsys.readouterr().out
    bench = load_bench(short)
    metadata = json.loads(out.read_text(encoding="utf-8").splitlines()[0].removeprefix("# "))
    currents, _ = read_design(out, bench)
    s = simulate(bench.plant(model), Theta(bench.brake), planned(currents), 1e-3, ("k_m", "T_c")).sensitivities[:, :, 0]
    log_det = np.linalg.slogdet(s.T @ s / bench.noise.angle**2)[1]
    assert metadata["value"] == pytest.approx(log_det, rel=1e-9)
    assert metadata["checks"][0]["value"] == pytest.approx(log_det, rel=1e-9)


def test_a_file_that_is_no_design_of_the_bench_is_refused(short: Path, tmp_path: Path) -> None:
    bench, path = load_bench(short), tmp_path / "design.csv"
    of_the_bench = json.dumps({"identity_hash": bench.identity_hash, "criterion": "D"})
    whole = "\n".join(["current", *["1.0"] * (PERIODS + 1)])
    path.write_text(f"# {of_the_bench}\n{whole}")
    assert read_design(path, bench)[0].tolist() == [1.0] * PERIODS
    for text in (
        *("", "#", "# []", "# 1\ncurrent\n1.0", f"# {'[' * 100_000}", "\0" * 100, "# {}\n" + whole),
        f"# {of_the_bench}\nspeed\n1.0",
        f"# {of_the_bench}\n{whole}\n1.0",
        f"# {of_the_bench}\n{whole}".replace("1.0", "nan"),
        f"# {of_the_bench}\n{whole}".replace("1.0", "one"),
        f"# {of_the_bench}\n{whole}".replace(bench.identity_hash, "another"),
    ):
        path.write_text(text)
        with pytest.raises(UsageError):
            read_design(path, bench)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError):
        read_design(path, bench)
    with pytest.raises(UsageError):
        read_design(tmp_path / "none.csv", bench)


def test_ctrl_c_writes_the_best_design_so_far(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def settled(history: list[float]) -> bool:
        if history:
            raise KeyboardInterrupt
        return False

    monkeypatch.setattr("emb_bench.design.search._settled", settled)
    out = tmp_path / "design.csv"
    assert main(["--bench", str(short), *QUICK, "--output", str(out)]) == EXIT_INTERRUPTED
    printed = capsys.readouterr()
    assert "(1 starts, seed 0, interrupted)" in printed.out
    assert "this is the best design so far" in printed.err
    assert json.loads(out.read_text(encoding="utf-8").splitlines()[0].removeprefix("# "))["interrupted"] is True
    assert read_design(out, load_bench(short))[0].shape == (PERIODS,)


def test_the_weighted_information_has_no_bound(short: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--bench", str(short), *QUICK, "--kind", "weighted", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["cramer_rao"] is None
