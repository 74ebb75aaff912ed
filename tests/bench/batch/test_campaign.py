"""The campaign's command, against the commands for one log and the plain readers of Parquet and MCAP."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomlkit
from mcap.reader import make_reader
from pyarrow import parquet

from emb_bench.batch.evaluate import evaluate_one
from emb_bench.batch.row import CampaignOptions, Source
from emb_bench.cli.replay import main
from emb_bench.config.bench import DRIVEN, parse_bench
from emb_bench.experiment.from_log import read_experiment
from emb_bench.logs.log import read_log
from emb_runtime.config.bench import PARAMETER_NAMES, Bench
from emb_runtime.records import RunType

from tests.bench.conftest import Replay  # isort: skip
from tests.bench.simulated_logs import square, write_log  # isort: skip
from tests.conftest import Simulate  # isort: skip

FAST = ("--starts", "2")
NO_RUN = ("broken/dangling.mcap", "broken/listened.mcap")
BROKEN = tuple(sorted((*NO_RUN, "broken/cut.mcap", "broken/empty.mcap", "broken/pipe.mcap", "broken/text.mcap")))
GOOD = ("friday/early.mcap", "monday/a.mcap", "monday/b.mcap", "tuesday/c.mcap", "tuesday/lag.mcap")


@dataclass(frozen=True)
class Said:
    """What a campaign said and wrote."""

    code: int
    rows: dict[str, dict[str, Any]]  # By log
    document: dict[str, Any]
    err: str
    path: Path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, simulate: Simulate, bench: Bench) -> Path:
    lagging = replace(bench, shield=bench.shield._replace(current_lag=0.002))
    root = tmp_path_factory.mktemp("campaign")
    for day in ("monday", "tuesday", "friday", "broken", "broken/folder.mcap"):
        (root / day).mkdir()
    write_log(root / "monday/a.mcap", simulate(square, options="plant=exact,seed=1"))
    write_log(root / "monday/b.mcap", simulate(square, options="plant=exact,seed=2"))
    write_log(root / "tuesday/c.mcap", simulate(square, options="plant=exact,f_v=3e-5,T_c=1.2e-2,seed=3"))
    write_log(
        root / "tuesday/lag.mcap",
        simulate(square, options="plant=lag,seed=4", on_bench=lagging),
        metadata={"emb.run": {}},
    )
    calls = iter(range(10**6))
    early = simulate(square, options="plant=exact,seed=5", stop_requested=lambda: next(calls) > 1000)
    write_log(root / "friday/early.mcap", early)
    write_log(root / "broken/listened.mcap", early, metadata={"emb.run": {"purpose": RunType.LISTEN_ONLY}})
    whole = (root / "monday/a.mcap").read_bytes()
    (root / "broken/cut.mcap").write_bytes(whole[:6000])
    (root / "broken/empty.mcap").touch()
    (root / "broken/text.mcap").write_text("time,angle\n0,0\n")
    (root / "broken/dangling.mcap").symlink_to("nowhere")
    os.mkfifo(root / "broken/pipe.mcap")
    (root / "broken/round").symlink_to("..")
    (root / "notes.txt").write_text("no log\n")
    return root


@pytest.fixture(scope="module")
def said(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Said]:
    path = tmp_path_factory.mktemp("result") / "result.parquet"
    with pytest.MonkeyPatch.context() as patch:
        yield campaign(patch, folder, path, *FAST, "--jobs", "2")


def campaign(patch: pytest.MonkeyPatch, folder: Path, path: Path, *arguments: str) -> Said:
    """Run the command in this process."""
    out, err = io.StringIO(), io.StringIO()
    patch.setattr("sys.stdout", out)
    patch.setattr("sys.stderr", err)
    code = main(["campaign", str(folder), "-o", str(path), "--json", *arguments])
    patch.undo()
    return Said(code, read(path), json.loads(out.getvalue()), err.getvalue(), path)


def read(path: Path) -> dict[str, dict[str, Any]]:
    rows: list[dict[str, Any]] = parquet.read_table(path).to_pylist()
    return {row["log"]: row for row in rows}


def finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def test_every_log_is_one_row_in_sorted_order(folder: Path, said: Said) -> None:
    assert list(said.rows) == sorted((*BROKEN, *GOOD))
    assert {row["root"] for row in said.rows.values()} == {str(folder)}
    assert {row["campaign"] for row in said.rows.values()} == {"broken", "monday", "tuesday", "friday"}


def test_broken_logs_fail_with_the_words_of_the_command_for_one_log(folder: Path, said: Said, replay: Replay) -> None:
    assert said.code == 1
    for log in BROKEN:
        row = said.rows[log]
        assert f"FAILED {row['error']}\n" in said.err
        assert row["log_det"] is None
        if log != "broken/pipe.mcap":
            code = 2 if log in NO_RUN else 6
            assert replay.refused("fim", folder / log, code=code) == f"emb-replay: {row['error']}\n"
    assert {one["log"] for one in said.document["failed"]} == set(BROKEN)
    assert all(said.rows[log]["error"] is None for log in GOOD)
    assert (said.document["evaluated"], said.document["incomplete"]) == (len(GOOD), 1)


def test_rows_say_what_fim_says_of_the_log_alone(folder: Path, said: Said, replay: Replay) -> None:
    for log in GOOD:
        row, its = said.rows[log], replay.document("fim", folder / log, "--theta", "nominal")
        assert (row["model"], row["exit_reason"], row["complete"]) == (
            its["model"],
            its["exit_reason"],
            its["complete"],
        )
        for name in ("planned", "periods", "measured", "command_delay"):
            assert row[name] == its["samples"][name]
        for name in ("log_det", "lambda_min", "trace_inverse"):
            assert finite(row[name]) == its["physical"][name]
        assert {name: finite(row[name]) for name in ("T", "I")} == {name: its["estimate"][name] for name in ("T", "I")}
        told = {finding["name"]: finding["identified"] for finding in its["physical"]["findings"]}
        assert {name: finite(row[f"{name}_cramer_rao"]) for name in told} == its["physical"]["cramer_rao"]
        assert (row["nominal_angle_sigmas"], row["nominal_velocity_sigmas"], row["nominal_fits"]) == (
            its["fit_sigmas"]["angle"],
            its["fit_sigmas"]["velocity"],
            its["fit_sigmas"]["fits"],
        )
        assert [*filter(None, [row["missing"]]), *row["warnings"]] == its["warnings"]


def test_rows_say_what_estimate_says_of_the_log_alone(folder: Path, said: Said, replay: Replay) -> None:
    for log in GOOD:
        row, its = said.rows[log], replay.document("estimate", folder / log, *FAST)
        assert (row["fits"], row["chi2_per_freedom"]) == (its["model_fits"], its["misfit"]["chi2_per_freedom"])
        assert row["alarms"] == its["misfit"]["alarms"]
        for name in PARAMETER_NAMES:
            found = its["parameters"][name]
            assert row[f"{name}_estimate"] == found["value"]
            assert [finite(row[f"{name}_low"]), finite(row[f"{name}_high"])] == found["interval_95"]
            assert finite(row[f"{name}_deviation"]) == found["deviation"]
            assert (row[f"{name}_identified"], row[f"{name}_true"]) == (found["identified"], found.get("true"))
            if "true" not in found:
                assert row[f"{name}_error_sigmas"] is None
                continue
            error = (found["value"] - found["true"]) / (found["deviation"] * found["value"])
            assert row[f"{name}_error_sigmas"] == pytest.approx(error)


def test_rows_say_what_info_says_of_the_log_alone(folder: Path, said: Said, replay: Replay) -> None:
    for log in GOOD:
        row, its = said.rows[log], replay.document("info", folder / log)
        assert (row["limited"], row["returning"], row["clipped"], row["missed"]) == tuple(
            its["cycles"][name] for name in ("limited", "returning", "clipped", "missed_periods")
        )
        largest = its["largest"]
        assert (row["angle_min"], row["angle_max"]) == (largest["angle_min"], largest["angle_max"])
        assert (row["speed_max"], row["current_max"]) == (largest["speed"], largest["current"])
        assert row["violations"] == 0


def test_identity_and_time_are_those_of_the_file_and_of_its_first_message(
    folder: Path, said: Said, bench: Bench
) -> None:
    for log in GOOD:
        row, data = said.rows[log], (folder / log).read_bytes()
        assert row["sha256"] == hashlib.sha256(data).hexdigest()
        assert (row["bench_name"], row["bench_hash"], row["policy_sha256"]) == (bench.name, bench.identity_hash, None)
        with (folder / log).open("rb") as file:
            first = min(message.publish_time for _, _, message in make_reader(file).iter_messages())
        assert int(row["start_time"].timestamp()) == first // 10**9
    table = parquet.read_table(said.path, columns=["start_time"])
    assert str(table.schema.field("start_time").type) == "timestamp[ns, tz=UTC]"


def test_columns_have_units_and_the_file_says_what_was_asked(said: Said) -> None:
    schema = parquet.read_schema(said.path)
    units = {field.name: (field.metadata or {}).get(b"unit", b"").decode() for field in schema}
    assert (units["angle_max"], units["speed_max"], units["current_max"], units["model"]) == ("rad", "rad/s", "A", "")
    assert units["k_m_estimate"] == units["k_m_low"] == units["k_m_true"] == "N·m/A"
    assert units["k_m_deviation"] == units["k_m_cramer_rao"] == units["k_m_error_sigmas"] == "1"
    assert all(field.metadata[b"about"] for field in schema if field.name not in ("root", "campaign", "log"))
    numbers = [field.name for field in schema if str(field.type) in ("double", "int64")]
    assert all(units[name] for name in numbers)
    asked = json.loads(schema.metadata[b"options"])
    assert (asked["method"], asked["params"], asked["starts"]) == ("oem", list(PARAMETER_NAMES), 2)
    assert (schema.metadata[b"logs"], schema.metadata[b"failed"]) == (b"11", b"6")
    assert schema.metadata[b"tool"].startswith(b"emb-excite ")


def test_one_process_gives_the_same_bytes_as_two(
    folder: Path, said: Said, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = campaign(monkeypatch, folder, tmp_path / "one.parquet", *FAST, "--jobs", "1")
    assert one.path.read_bytes() == said.path.read_bytes()
    assert one.document | {"result": ""} == said.document | {"result": ""}


def test_information_alone_estimates_nothing(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, replay: Replay
) -> None:
    path = tmp_path / "r.parquet"
    asked = ("--method", "none", "--params", "k_m,f_v", "--model", "exact", "--jobs", "1")
    found = campaign(monkeypatch, folder / "tuesday", path, *asked)
    assert found.code == 0
    assert len(found.document["misfit"]) == 2
    row, its = (
        found.rows["c.mcap"],
        replay.document("fim", folder / "tuesday/c.mcap", "--theta", "nominal", "--params", "k_m,f_v"),
    )
    assert row["campaign"] == "."
    assert {name: row[f"{name}_cramer_rao"] for name in ("k_m", "f_v")} == its["physical"]["cramer_rao"]
    assert (row["fits"], row["f_v_estimate"], row["f_v_true"]) == (None, None, 3e-5)
    assert "T_c_cramer_rao" not in row
    assert not any(p["estimate"] for p in found.document["parameters"].values())


def test_a_log_of_another_sample_time_than_the_bench_fails_with_what_is_known_of_it(folder: Path, bench: Bench) -> None:
    other = parse_bench(bench.text.replace("sample_time = 1.0e-3", "sample_time = 2.0e-3"), "other", analysis=True)
    path = folder / "monday/a.mcap"
    row = evaluate_one(Source(str(path), str(folder), "monday/a.mcap", "monday"), CampaignOptions(), other)
    assert row["error"] == f"{path}: expected a sample time of 0.002 s, as in the bench file, got 0.001 s"
    assert row["exit_reason"] == "DONE"
    assert "log_det" not in row


def test_the_unknowns_of_a_machine_s_bench_are_those_of_rows_summary_and_file(
    folder: Path, bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = tomlkit.parse(bench.text)
    for driven in (*DRIVEN, "estimator"):
        text.pop(driven, None)
    text["machine"] = {"unknown": ["T_c", "J"]}
    machine = tmp_path / "machine.toml"
    machine.write_text(tomlkit.dumps(text))
    asked = ("--bench", str(machine), "--nuisance", "k_m", "--method", "none", "--jobs", "1")
    found = campaign(monkeypatch, folder / "tuesday", tmp_path / "r.parquet", *asked)
    assert found.code == 0
    assert [*found.document["parameters"]] == ["T_c", "J", "k_m"]
    assert {name.removesuffix("_cramer_rao") for name in found.rows["c.mcap"] if name.endswith("_cramer_rao")} == {
        *found.document["parameters"]
    }
    assert all(p["identified"] is not None for p in found.document["parameters"].values())
    options = json.loads(parquet.read_schema(found.path).metadata[b"options"])
    assert (options["params"], options["nuisances"]) == (["T_c", "J"], ["k_m"])


def test_samples_beyond_a_limit_are_counted(folder: Path, bench: Bench) -> None:
    path = folder / "monday/a.mcap"
    experiment = read_experiment(read_log(path))
    speeds = np.sort(np.abs(experiment.all_samples[:, 1]))
    limit = f"{0.5 * (speeds[-8] + speeds[-7]):.6f}"
    narrow = re.sub(r"(?m)^velocity = [0-9.e]+( .*rad/s.*)$", f"velocity = {limit}", bench.text, count=1)
    its = parse_bench(narrow, "narrow", analysis=True)
    row = evaluate_one(Source(str(path), "", "a.mcap", "."), CampaignOptions(method="none"), its)
    assert (row["error"], row["violations"]) == (None, 7)
