"""What the commands compute, beside stored documents: ``pytest tests/golden --update-golden`` writes them anew.

One file a command, one line a call. A value and the ends of its interval may differ by a thousandth of the deviation,
other numbers by TOLERANCES: another processor rounds otherwise. Whole numbers are equal but for ROUNDED. Left out are
sentences, which ``test_golden.py`` reads,
and what depends on the version, the computer or the date.
"""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeGuard

import pytest

from emb_bench.cli.design import main as emb_design
from emb_bench.cli.replay import main as emb_replay
from emb_runtime.cli.main import main as emb_run

FOLDER = Path(__file__).parent / "documents"
LOGS = ["used", "good", "noisy", "aborted", "damaged", "still"]
CALLS = {
    "run": [
        "--iface sim:seed=3",
        "--iface sim:seed=4,f_v=4e-5,k_1=15 --quick",
        "--iface sim --limit 1 --home",
        "--iface sim:k_m=0.06",
        "--iface sim:T_c=0.05",
        "--iface sim:plant=late",
        "--iface sim:k_m=-0.02",
    ],
    "info": [f"{log}.mcap" for log in (*LOGS, "cut", "rejected", "broken")],
    "timing": ["used.mcap", "damaged.mcap", "used.mcap rejected.mcap"],
    "rerun": [f"{log}.mcap" for log in ("used", "rejected", "cut", "damaged")],
    "fim": [
        *(f"{log}.mcap --theta nominal" for log in (*LOGS, "rejected")),
        "good.mcap --theta nominal --nuisance J --prior pm50",
    ],
    "estimate": [
        *(f"{log}.mcap --starts 1" for log in LOGS[:-1]),
        *(f"good.mcap --starts 1 --method {method}" for method in ("pem", "rls", "windows --window 0.04")),
        "other.mcap --starts 1 --model exact",
        "good.mcap again.mcap third.mcap --starts 1",
        "recording.csv --map map.toml --starts 1",
    ],
    "report": ["used.mcap --starts 1", "good.mcap worn.mcap --compare --starts 1"],
    "campaign": ["good.mcap again.mcap worn.mcap aborted.mcap broken.mcap -o rows.parquet --starts 1 --jobs 1"],
    "design": ["--bench short.toml --starts 1 --model euler --criterion D --params k_m,T_c"],
}
TOLERANCES = {"info": 1e-6, "timing": 1e-6, "rerun": 1e-6, "fim": 1e-4, "run": 0.02, "design": 1e-3}
"""Of the largest number in the same list; of other commands 0.01."""
DEVIATIONS = 1e-3
ROUNDED = re.compile(r".*/(limited|returning|log_bytes)")
"""Whole numbers that follow from rounding: where the shield or the way home begins, and how long a packed log is."""
LEFT_OUT = re.compile(
    r".*(hash|sha256|provenance)|log|number|made_by|version|bench_name|file|starts|attachments|chi2_p|p_value|effects|over_time"
    r"|command|core|python|numpy|onnxruntime|kernel|iface|interface|disk|recorded|(emb\.)?preflight|time|unit|schema|advice"
)
NUMBER = re.compile(r"-?\d+\.\d+(e-?\d+)?")
"""Of a log's metadata, which are texts."""
LONG = 24
"""Of a longer list the length and six of its numbers are stored."""


@pytest.mark.parametrize("command", CALLS)
def test_a_command_computes(
    command: str,
    folder: Path,
    request: pytest.FixtureRequest,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(folder)
    found = {}
    for n, call in enumerate(CALLS[command]):
        arguments = call.split()
        if command == "run":
            code = emb_run([*arguments, "--log", f"run-{n}.mcap", "--json"])
        elif command == "design":
            code = emb_design([*arguments, "--json"])
        else:
            code = emb_replay([command, *arguments, *(["-o", "page.html"] if command == "report" else ["--json"])])
        said = capsys.readouterr().out
        text = Path("page.json").read_text(encoding="utf-8") if command == "report" else said
        found[call] = {"code": code, "says": stored(json.loads(text or "null"))}
    path = FOLDER / f"{command}.json"
    if request.config.getoption("--update-golden"):
        lines = [f"{json.dumps(k)}: {json.dumps(v, ensure_ascii=False)}" for k, v in found.items()]
        path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    golden = json.loads(path.read_text(encoding="utf-8"))
    if differing := list(differences(golden, found, TOLERANCES.get(command, 0.01))):
        pytest.fail(f"{path}:\n" + "\n".join(differing), pytrace=False)


def test_a_hundredth_of_a_deviation_is_a_difference_and_a_new_key_too() -> None:
    golden = {"k_m": {"value": 0.0217, "deviation": 1e-4, "sigmas": 2.0}}
    for value, found in ((0.0217 + 9e-8, 0), (0.0217 + 1e-6, 1), (math.nan, 1)):
        assert len([*differences(golden, {"k_m": {**golden["k_m"], "value": value}}, 0.01)]) == found
    assert [*differences(golden, {**golden, "new": 1}, 0.01)]


def test_a_count_is_equal_or_another_one() -> None:
    counts = {"periods": 10_000, "limited": 10_000}
    assert [*differences(counts, {"periods": 10_001, "limited": 10_001}, 0.01)] == ["/periods: 10000 became 10001"]


def test_numbers_computed_again_from_nothing_but_one_log_are_the_same(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said = []
    for place in (folder, tmp_path):
        if place is tmp_path:
            shutil.copy(folder / "good.mcap", tmp_path)
        monkeypatch.chdir(place)
        assert emb_replay(["estimate", "good.mcap", "--starts", "3", "--json"]) == 0
        said.append(json.loads(capsys.readouterr().out))
    assert said[0] == said[1]


def stored(value: Any, digits: int = 6) -> Any:
    """A document without what is left out, rounded, with lists of named members as a mapping: their order is free."""
    if isinstance(value, Mapping):
        return {k: stored(v, 10 if is_estimate(k) else digits) for k, v in value.items() if not LEFT_OUT.fullmatch(k)}
    if isinstance(value, list) and value and all(isinstance(v, Mapping) and "name" in v for v in value):
        return {v["name"]: stored({k: x for k, x in v.items() if k != "name"}) for v in value}
    if isinstance(value, list) and len(value) > LONG and all(map(is_number, value)):
        return [len(value), *stored([*value[:3], *value[-3:]])]
    if isinstance(value, list):
        return [stored(v, digits) for v in value]
    if isinstance(value, float) and math.isfinite(value):
        return float(f"{value:.{digits}g}")
    if isinstance(value, str) and NUMBER.fullmatch(value):
        return stored(float(value))
    return "…" if isinstance(value, str) and " " in value else value


def differences(old: Any, new: Any, relative: float, path: str = "", allowed: float = 0.0) -> Iterator[str]:
    """Paths at which two documents differ, and both values; the values around may have allowed a distance."""
    if isinstance(old, dict) and isinstance(new, dict) and old.keys() == new.keys():
        for key, value in old.items():
            near = DEVIATIONS * (deviation_of(old, key) if is_estimate(key) else float(key == "sigmas"))
            yield from differences(value, new[key], relative, f"{path}/{key}", near)
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        size = allowed or max((relative * abs(v) for v in old if is_number(v)), default=0.0)
        for n, (a, b) in enumerate(zip(old, new, strict=True)):
            yield from differences(a, b, relative, f"{path}/{n}", size)
    elif is_number(old) and is_number(new) and not (is_count(old) and is_count(new) and not ROUNDED.fullmatch(path)):
        near = allowed or max(relative * abs(old), 1e-9)
        if not abs(old - new) <= near and not (math.isnan(old) and math.isnan(new)):
            yield f"{path}: {old} became {new}, {abs(old - new) / near:.3g} times what is allowed"
    elif old != new:
        yield f"{path}: {str(old)[:80]} became {str(new)[:80]}"


def deviation_of(document: Mapping[str, Any], key: str) -> float:
    """Standard deviation of what a document states: of a value that between runs, of its interval the total."""
    value, sigmas = document.get("value"), document.get("sigmas")
    deviation = document.get("deviation_between_runs" if key == "value" else "", document.get("deviation"))
    if is_number(value) and is_number(deviation):
        return deviation * (abs(value) if document.get("deviation_relative") else 1.0)
    return abs(value / sigmas) if is_number(value) and is_number(sigmas) and sigmas else 0.0


def is_estimate(key: str) -> bool:
    return key in ("value", "mean", "true") or key.startswith("interval")


def is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)
