"""``emb-run --commission`` on the command line: what does not go with it, and what it needs, in one line."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

import pytest

from emb_runtime.cli import commissioning
from emb_runtime.cli.main import main


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (["--zero"], "--zero"),
        (["--limit", "1"], "--limit"),
        (["--repeat", "3"], "--repeat"),
        (["--policy", "x.onnx", "--home"], "--policy, --home"),
        (["--log", "runs/x.mcap"], "--log"),
        (["--duration", "0.1"], "--duration"),
    ],
)
def test_what_it_chooses_by_itself_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], named: str
) -> None:
    folder = tmp_path / "brake"
    assert main(["--iface", "sim", "--commission", str(folder), *more]) == 2
    assert capsys.readouterr().err == f"emb-run: --commission: chooses {named} by itself, step by step\n"
    assert not folder.exists()


def test_without_an_estimator_it_says_so_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metadata, "entry_points", lambda **_: [])
    assert main(["--iface", "sim", "--commission", str(tmp_path / "brake")]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "emb_bench" in err


def test_the_examiner_of_this_package_is_registered() -> None:
    (entry,) = metadata.entry_points(group=commissioning.ENTRY_POINTS, name="logs")
    assert {"ended", "rest", "current", "first_move", "identify"} <= set(dir(entry.load()))


@pytest.mark.parametrize("folder", ["file", "file/below"])
def test_a_folder_that_cannot_be_made_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], folder: str
) -> None:
    (tmp_path / "file").write_text("")
    assert main(["--iface", "sim", "--commission", str(tmp_path / folder)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_on_a_real_bus_every_step_is_confirmed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--iface", "can0", "--commission", str(tmp_path / "brake"), "--no-rt"]) == 2
    assert "--confirm: there is nobody to ask" in capsys.readouterr().err
    assert not list((tmp_path / "brake").glob("*.mcap"))
