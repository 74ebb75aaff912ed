"""Each command on a recording of others: it works, or says in one line what it lacks; the page has the same table."""

from __future__ import annotations

from pathlib import Path

import pytest

from emb_bench.cli.replay import COMMANDS, main
from tests.bench.linear_machine import MAP, Machine, record

WORKS: dict[str, tuple[str, ...]] = {
    "info": ("info", "RUN"),
    "fim": ("fim", "RUN"),
    "estimate": ("estimate", "RUN", "--starts", "1"),
    "estimate --method pem": ("estimate", "RUN", "--method", "pem", "--starts", "1"),
    "report": ("report", "RUN", "--starts", "1", "-o", "OUT.html"),
    "campaign": ("campaign", "RUN", "-o", "OUT.parquet", "--method", "windows", "--params", "J,T_c,f_v", "--nuisance",
                 "current_offset", "--starts", "1", "--jobs", "1"),
    "export -o FILE.csv": ("export", "RUN", "-o", "OUT.csv"),
    "export -o FILE.parquet": ("export", "RUN", "-o", "OUT.parquet"),
    "export -o FILE.png": ("export", "RUN", "-o", "OUT.png"),
    "repair": ("repair", "RUN", "-o", "OUT.mcap"),
    "live": ("live", "RUN", "--port", "0"),
}  # fmt: skip
LACKS: dict[str, tuple[tuple[str, ...], str]] = {
    "timing": (("timing", "RUN"), "no timing"),
    "rerun": (("rerun", "RUN"), "no loop to run again"),
    "export -o FILE.xml": (("export", "RUN", "-o", "OUT.xml"), "the log of a brake"),
    "estimate --method rls": (("estimate", "RUN", "--method", "rls"), "another method does"),
    "estimate --model all": (("estimate", "RUN", "--model", "all"), "expected --method oem"),
    "estimate --grow": (("estimate", "RUN", "--grow"), "expected --method oem"),
    "estimate --params k_1": (("estimate", "RUN", "--params", "k_1"), "zero in this bench"),
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("others")
    rows = zip(*(column.tolist() for column in record(Machine(), 2.0)), strict=True)
    (folder / "r.csv").write_text("t,x,F\n" + "".join(f"{t!r},{x!r},{f!r}\n" for t, x, f in rows))
    (folder / "map.toml").write_text(MAP.replace("window = 0.5", "window = 0.05"))
    out = folder / "run.mcap"
    assert main(["import", str(folder / "r.csv"), "--map", str(folder / "map.toml"), "-o", str(out)]) == 0
    return str(out)


def called(words: tuple[str, ...], run: str, folder: Path) -> int:
    return main([run if w == "RUN" else w.replace("OUT", str(folder / "out")) for w in words])


@pytest.mark.parametrize("name", WORKS)
def test_a_command_works_and_says_nothing_of_a_loop(
    name: str, run: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert called(WORKS[name], run, tmp_path) in (0, 1)
    said = capsys.readouterr().out
    for nonsense in ("missed", "unanswered", "returning home", "braked by the node", "nan", "sensor to command"):
        assert nonsense not in said


@pytest.mark.parametrize("name", LACKS)
def test_a_command_says_in_one_line_what_it_lacks(
    name: str, run: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words, expected = LACKS[name]
    capsys.readouterr()
    assert called(words, run, tmp_path) in (2, 6)
    said = capsys.readouterr().err.strip()
    assert expected in said
    assert "\n" not in said


def test_a_row_of_a_campaign_has_no_counts_of_a_loop_and_no_date(run: str, tmp_path: Path) -> None:
    from pyarrow import parquet

    assert called(("campaign", "RUN", "-o", "OUT.parquet", "--params", "J,T_c,f_v", "--jobs", "1"), run, tmp_path) == 0
    row = parquet.read_table(tmp_path / "out.parquet").to_pylist()[0]
    assert row["error"] is None
    assert [row[name] for name in ("missed", "clipped", "limited", "returning", "start_time")] == [None] * 5


def test_the_page_has_every_command_and_there_is_no_other() -> None:
    page = (Path(__file__).parents[3] / "docs/howto/recordings-of-others.md").read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    for name in (*WORKS, *LACKS):
        assert any(f"`{name}`" in row for row in rows), name
    names = {*COMMANDS}
    assert {name.split()[0] for name in (*WORKS, *LACKS)} | {"import"} == names
