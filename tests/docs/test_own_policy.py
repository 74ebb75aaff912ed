"""The examples that bring an own policy run, from their first line to a driven brake."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from emb_bench import api

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/howto/bring-your-own-policy.md"


def examples(path: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def shortened(example: str) -> str:
    """The same with fewer steps: what is learned is not what is tested."""
    short, count = re.subn(r"learn\(100_000\)|range\(3000\)", lambda m: re.sub(r"\d[\d_]*", "200", m[0]), example)
    assert count == ("learn(" in example or "range(" in example)
    return (
        short.replace("n_steps=500", "n_steps=50")
        .replace("n_steps=512", "n_steps=64")
        .replace("batch_size=1000", "batch_size=50")
    )


@pytest.mark.parametrize(
    ("path", "index", "most"),
    [(PAGE, 0, 27), (PAGE, 1, 7), (PAGE, 2, 20), (ROOT / "README.md", 1, 8)],
    ids=["torch", "speed", "sb3", "readme"],
)
def test_an_example_exports_a_policy_that_drives(
    path: Path,
    index: int,
    most: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    example = examples(path)[index]
    assert len([line for line in example.splitlines() if line]) <= most
    monkeypatch.chdir(tmp_path)
    exec(compile(shortened(example), path.name, "exec"), {"__name__": "__main__"})
    assert capsys.readouterr().out.startswith("actor.onnx: ")
    run = api.simulate(tmp_path / "run.mcap", policy=tmp_path / "actor.onnx")
    assert run.exit_reason == "DONE"


def test_the_table_of_the_page_is_a_profile(tmp_path: Path) -> None:
    (table,) = re.findall(r"^```text\n(time.*?)^```$", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    (tmp_path / "profile.csv").write_text(table, encoding="utf-8")
    assert "3 rows" in api.export_policy(tmp_path / "profile.csv", tmp_path / "profile.onnx")
    run = api.simulate(tmp_path / "run.mcap", policy=tmp_path / "profile.onnx")
    wanted = [run.policy_current[k] for k in (0, 99, 100, 199, 200, 499)]
    assert wanted == [3.0, 3.0, -3.0, -3.0, 0.0, 0.0]
