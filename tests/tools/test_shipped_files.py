"""Files that are shipped and made from the code are current, and do in an editor and a shell what they are for."""

from __future__ import annotations

import re
import subprocess
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from emb_bench.commission.bench_file import working_text
from emb_bench.config.bench import load_bench, parse_bench
from emb_bench.recordings.map_file import parse_map
from emb_bench.report.acceptance import read_criteria
from emb_runtime.cli.main import main as emb_run
from emb_runtime.config.bench import shipped_bench_text
from emb_runtime.config.schemas import SCHEMAS
from emb_runtime.drives.mapping_file import parse_mapping
from emb_runtime.errors import EmbError
from tools.shipped_files import COMMANDS, ROOT, schema, shipped_files

SHIPPED = [ROOT / "runtime/emb_runtime/config/bench.toml", *sorted((ROOT / "examples").rglob("*.toml"))]
DBC = (ROOT / "examples" / "drives" / "odrive.dbc").read_text(encoding="utf-8")
MAPPING = (ROOT / "examples" / "drives" / "odrive.toml").read_text(encoding="utf-8")


def page(name: str) -> str:
    """The whole file that a page shows: its first block of TOML."""
    text = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
    return text.partition("```toml\n")[2].partition("```")[0]


def problems(kind: str, text: str) -> list[str]:
    """What an independent validator has against a file."""
    known = schema(kind)
    jsonschema.Draft7Validator.check_schema(known)
    return [error.message for error in jsonschema.Draft7Validator(known).iter_errors(tomllib.loads(text))]


def schema_of(path: Path) -> Path:
    """The file that the first line of a TOML file leads an editor to."""
    head, _, place = path.read_text(encoding="utf-8").partition("\n")[0].partition(" ")
    assert head == "#:schema"
    assert place.startswith(("./", "../"))
    return path.parent / place


def test_they_are_current() -> None:
    for path, text in shipped_files():
        assert path.read_text(encoding="utf-8") == text, f"{path}: python -m tools.shipped_files"


def test_a_shipped_file_leads_to_a_schema_that_takes_it() -> None:
    for path in SHIPPED:
        kind = schema_of(path).name.partition(".")[0]
        assert schema_of(path).is_file(), path
        assert problems(kind, path.read_text(encoding="utf-8")) == [], path


def test_what_commands_write_leads_to_the_schema_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "my.toml"
    assert emb_run(["--write-bench", str(path)]) == 0
    assert sorted(one.name for one in tmp_path.iterdir()) == ["bench.schema.json", "my.toml"]
    path.write_text(working_text(load_bench(path)), encoding="utf-8")
    assert schema_of(path).is_file()
    assert problems("bench", path.read_text(encoding="utf-8")) == []
    assert emb_run(["--write-schemas", str(tmp_path)]) == 0
    assert {one.name for one in tmp_path.glob("*.json")} == {f"{kind}.schema.json" for kind in SCHEMAS}


def read_acceptance(text: str, folder: Path) -> object:
    (folder / "a.toml").write_text(text, encoding="utf-8")
    return read_criteria(folder / "a.toml")


FILES: dict[str, tuple[str, Callable[[str, Path], object], list[tuple[str, str]]]] = {
    "bench": (
        shipped_bench_text(),
        lambda text, _: parse_bench(text, "bench.toml"),
        [
            ("k_m   = 2.170e-2", 'k_m = "0.0217"'), ("T_c   = 1.037e-2", "T_c = 0"), ("current  =", "curent  ="),
            (r"angle    = \[-10.0,", "angle = [0, -10.0,"), (r"\[ranges.viscous\]", "[ranges.viscous]\nf_w = [1, 2]"),
            ("schema = 1", "schema = 2"), (r"\[node\]", "[nodes]"), ("\nmissed *=.*", "\nmissed = 2"),
            (r"\[plants\..*\]", '[plants.mine]\nsolver = "odd"'),
        ],
    ),
    "mapping": (
        MAPPING,
        lambda text, _: parse_mapping(text, DBC, "drive.toml"),
        [
            ('unit = "rev",', 'unit = "turns",'), ("sign = 1, ", "sign = 2, "), ("default = ", "other = 1\ndefault = "),
            (r"\[node\]", ""),
        ],
    ),
    "map": (
        page("howto/recordings-of-others"),
        lambda text, _: parse_map(text, "map.toml"),
        [
            ("sample_time = 1.0e-3", "sample_time = 1"), ("scale = 1.0", "scale = 0"), ('column = "x"', ""),
            (r"\[timing\]", "[times]"),
        ],
    ),
    "acceptance": (
        page("reference/acceptance"),
        read_acceptance,
        [("relative = 0.2", "relative = -0.2"), ("model_fit = true", "model_fit = 1"), ("model_fit =", "source =")],
    ),
}  # fmt: skip
"""Of each kind: a file, what reads it, and replacements that make it wrong."""


@pytest.mark.parametrize("kind", SCHEMAS)
def test_a_schema_takes_what_its_reader_takes_and_refuses_what_a_typing_mistake_makes_of_it(
    kind: str, tmp_path: Path
) -> None:
    right, read, mistakes = FILES[kind]
    read(right, tmp_path)
    assert problems(kind, right) == []
    for old, new in mistakes:
        wrong, count = re.subn(old, new, right, count=1)
        assert count, old
        assert problems(kind, wrong), new
        with pytest.raises(EmbError):
            read(wrong, tmp_path)


def test_a_machine_has_no_shield_and_every_other_bench_has_one() -> None:
    document: dict[str, Any] = tomllib.loads(shipped_bench_text())
    for key in ("ranges", "shield", "watch", "guard", "node", "can"):
        del document[key]
    judge = jsonschema.Draft7Validator(schema("bench"))
    assert not judge.is_valid(document)
    assert judge.is_valid(document | {"machine": {"unknown": ["T_c"]}})


@pytest.mark.parametrize(
    "typed", ["emb-run --log", "emb-replay estimate", "emb-replay fim run.mcap --theta", "emb-commission", "emb-export"]
)
def test_bash_completes_names_of_files(typed: str, tmp_path: Path) -> None:
    (tmp_path / "mine.csv").touch()
    command, count = typed.split()[0], len(typed.split())
    asked = (
        f"source {ROOT / 'completions' / 'bash' / command}; COMP_WORDS=({typed} mi); COMP_CWORD={count}; "
        f"$(complete -p {command} | sed 's/.*-F \\([^ ]*\\) .*/\\1/'); echo ${{COMPREPLY[@]}}"
    )
    done = subprocess.run(["bash", "-c", asked], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert (done.stdout, done.stderr) == ("mine.csv\n", "")


@pytest.mark.parametrize("command", COMMANDS)
def test_bash_completes_options_and_commands(command: str) -> None:
    script = ROOT / "completions" / "bash" / command
    estimate = "COMP_WORDS=(emb-replay esti); COMP_CWORD=1; $f; echo ${COMPREPLY[@]}; "
    of_replay = estimate if command == "emb-replay" else ""
    asked = (
        f"source {script}; complete -p {command}; f=$(complete -p {command} | sed 's/.*-F \\([^ ]*\\) .*/\\1/'); "
        f"{of_replay}COMP_WORDS=({command} --vers); COMP_CWORD=1; $f; echo ${{COMPREPLY[@]}}"
    )
    done = subprocess.run(["bash", "-c", asked], capture_output=True, text=True, check=True)
    said = done.stdout.split("\n")
    assert said[0].endswith(f" {command}")
    assert said[1:-1] == [*(["estimate"] if of_replay else []), "--version"]
    assert done.stderr == ""
