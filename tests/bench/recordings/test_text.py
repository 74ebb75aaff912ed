"""Text files as loggers write them are read, or refused with the line or row and the key that reads them."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from emb_bench.experiment.experiment import Lack
from emb_bench.recordings.recording import open_recording
from emb_runtime.errors import UsageError
from tests.bench.recordings.turning import TIMED, columns, csv_text, put

RIGHT = columns(periods=100)
PLAIN = csv_text(RIGHT)


def at_row(row: int, text: str, column: int = 1) -> Callable[[str], str]:
    """A text in place of the number in a row and a column."""

    def changed(content: str) -> str:
        lines = content.split("\n")
        parts = lines[row].split(",")
        lines[row] = ",".join([*parts[:column], text, *parts[column + 1 :]])
        return "\n".join(lines)

    return changed


class Form(NamedTuple):
    """A form of the text."""

    content: str | bytes | Callable[[str], str]
    text: Mapping[str, str] = {}  # Lines of the map
    refused: str = ""  # What is said; empty if it is read
    lost: int = 0  # Samples


NUMBERS = {"timing": 'column = "1"', "file": "head = 0"}
READ = {
    "as it is": Form(PLAIN),
    "lines of Windows": Form(PLAIN.replace("\n", "\r\n")),
    "lines of an old Mac": Form(PLAIN.replace("\n", "\r")),
    "the mark of UTF-8": Form(PLAIN.encode("utf-8-sig")),
    "UTF-16": Form(PLAIN.encode("utf-16")),
    "a preamble": Form("Logger: bench 3\nStart: 17.03.2026 21:29\n\n" + PLAIN),
    "a head that is a comment": Form("# made by a logger\n# " + PLAIN),
    "a head by its line": Form("t,angle,velocity,current\n" + PLAIN, {"file": "head = 2"}),
    "quotes": Form(re.sub(r"([^,\n]+)", r'"\1"', PLAIN)),
    "a delimiter behind each row": Form(PLAIN.replace("\n", ",\n")),
    "one behind the head alone": Form(PLAIN.replace("\n", ",\n", 1)),
    "semicolons behind rows": Form(PLAIN.replace("\n", ";\n")),
    "columns aligned by blanks": Form(PLAIN.replace(",", "   "), {"file": 'delimiter = " "'}),
    "tabs": Form(PLAIN.replace(",", "\t"), {"file": 'delimiter = "tab"'}),
    "a comma for the point": Form(
        PLAIN.replace(",", ";").replace(".", ","), {"file": 'delimiter = ";"\ndecimal = ","'}
    ),
    "units below the head": Form(PLAIN.replace("\n", "\ns,rad,rad/s,A\n", 1), {"file": "skip = 1"}),
    "a delimiter behind each row but the head": Form(PLAIN.replace("\n", ",\n").replace(",\n", "\n", 1)),
    "lines behind the rows": Form(PLAIN + "end of\nrecord\n", {"file": f"rows = [1, {len(RIGHT['t'])}]"}),
    "texts behind the rows": Form(PLAIN + "end,of,the,record\n", {"file": f"rows = [1, {len(RIGHT['t'])}]"}),
    "exponents of Fortran": Form(re.sub(r"-?\d[-.\de]*", lambda m: f"{float(m[0]):.9e}".replace("e", "D"), PLAIN)),
    "times of day with fractions": Form(re.sub(r"(?m)^([\d.]+),", lambda m: f"10:00:{float(m[1]):06.3f},", PLAIN)),
    "a row that is cut": Form(PLAIN + "0.2,3.4"),
    "a usual text": Form(at_row(50, "N/A"), lost=1),
    "a text of the map": Form(at_row(50, "---"), {"file": 'missing = ["---"]'}, lost=1),
    "ticks": Form(csv_text(RIGHT | {"t": RIGHT["t"] * 8000.0}), {"timing": f"{TIMED}\ntick = 1.25e-4"}),
    "a second column of times": Form(
        csv_text(RIGHT | {"t": 7.0 + 0.0 * RIGHT["t"], "us": np.round(RIGHT["t"] * 1e6)}),
        {"timing": f'{TIMED}\nfraction = "us"'},
    ),
    "times of a clock": Form(
        "\n".join(
            re.sub(r"^[\d.]+", f"2026-03-17 21:29:00.{2 * (k - 1):03d}", line)
            for k, line in enumerate(PLAIN.split("\n"))
        )
    ),
}
REFUSED = {
    "no head": Form(PLAIN.partition("\n")[2], {}, "No head: its first line is numbers; with [file] head = 0"),
    "a line that is no line": Form(PLAIN, {"file": "head = 4000"}, "[file] head = 4000: expected one of its"),
    "UTF-16 without its mark": Form(
        PLAIN.encode("utf-16-le"), {}, 'UTF-16 without its mark: [file] encoding = "utf-16-le"'
    ),
    "lines behind the rows": Form(
        PLAIN + "end of record\n", {}, f"[file] rows = [1, {len(RIGHT['t'])}] reads those before"
    ),
    "texts behind the rows": Form(
        PLAIN + "end,of,the,record\n", {}, f"rows = [1, {len(RIGHT['t'])}] all from there on"
    ),
    "names in another encoding": Form(
        PLAIN.replace("angle", "角度").encode("shift_jis"), {}, "If these names look wrong, [file] encoding names"
    ),
    "another delimiter": Form(PLAIN.replace(",", ";"), {}, 'With [file] delimiter = ";" line 1 has them'),
    "another name": Form(PLAIN.replace("angle", "Winkel"), {}, "no column is called 'angle'; it has: t, Winkel"),
    "the same behind a preamble": Form("x\n\n" + PLAIN.replace("angle", "W"), {}, "in line 3, taken for the head"),
    "the same twice": Form(PLAIN.replace("velocity", "angle"), {}, "no column is called 'velocity'"),
    "a dash": Form(at_row(50, "-"), {}, "angle: row 50: expected a number, got '-': [file] missing = ['-']"),
    "a fault of a table": Form(at_row(99, "#DIV/0!", 3), {}, "current: row 99: expected a number, got '#DIV/0!'"),
    "units": Form(PLAIN.replace("\n", "\ns,rad,rad/s,A\n", 1), {}, "[file] skip = 1 leaves out a line of units"),
    "a comma": Form(PLAIN.replace(",", ";").replace(".", ","), {"file": 'delimiter = ";"'}, '[file] decimal = ","'),
    "a short row": Form(
        PLAIN.replace("\n0.1,", "\n0.1\n0.1,"), {}, "line 52: expected 4 columns, got 1: [file] rows = [1, 50] reads"
    ),
    "not the encoding": Form("t,\xff".encode("latin-1"), {"file": 'encoding = "utf-8"'}, "line 1: not text in utf-8"),
    "no encoding": Form(PLAIN, {"file": 'encoding = "rot13"'}, "file.encoding: expected one such as utf-8"),
    "rows the wrong way": Form(PLAIN, {"file": "rows = [9, 3]"}, "file.rows: expected the first row, then the last"),
}


def written(folder: Path, form: Form) -> tuple[Path, Path]:
    content = form.content
    return put(folder, content(PLAIN) if callable(content) else content, form.text)


@pytest.mark.parametrize("name", READ)
def test_a_text_is_read_as_it_was_meant(name: str, tmp_path: Path) -> None:
    found = open_recording(*written(tmp_path, READ[name])).experiment
    angle = found.all_samples[:, 0]
    there = np.isfinite(angle)
    assert (~there).sum() == READ[name].lost
    np.testing.assert_allclose(angle[there], RIGHT["angle"][there], atol=1e-8)
    np.testing.assert_allclose(found.currents, RIGHT["current"][:-1], atol=1e-8)


@pytest.mark.parametrize("name", REFUSED)
def test_a_text_that_is_not_read_is_refused_with_the_key_that_reads_it(name: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError) as refused:
        open_recording(*written(tmp_path, REFUSED[name]))
    assert REFUSED[name].refused in str(refused.value)


@pytest.mark.parametrize(("encoding", "key"), [("cp1252", ""), ("cp1252", "cp1252"), ("shift_jis", "shift_jis")])
def test_names_in_another_encoding_are_found(encoding: str, key: str, tmp_path: Path) -> None:
    title = "Winkel [°]"
    source, map_path = put(
        tmp_path, PLAIN.replace("angle", title).encode(encoding), {"file": key and f'encoding = "{key}"'}
    )
    map_path.write_text(map_path.read_text().replace('"angle"', f'"{title}"'), encoding="utf-8-sig")
    np.testing.assert_allclose(open_recording(source, map_path).experiment.all_samples[:, 0], RIGHT["angle"], atol=1e-8)


def test_columns_without_a_head_have_numbers(tmp_path: Path) -> None:
    source, map_path = put(tmp_path, PLAIN.partition("\n")[2], NUMBERS, "r.dat")
    text = map_path.read_text()
    for number, name in enumerate(("angle", "velocity", "current"), 2):
        text = text.replace(f'"{name}"', f'"{number}"')
    map_path.write_text(text)
    np.testing.assert_allclose(open_recording(source, map_path).experiment.all_samples[:, 0], RIGHT["angle"], atol=1e-8)


def test_the_line_of_a_head_that_was_found_is_said(tmp_path: Path) -> None:
    assert open_recording(*written(tmp_path, READ["a preamble"])).experiment.quality.lacks[Lack.HEAD] == (4,)
    assert Lack.HEAD not in open_recording(*written(tmp_path, READ["as it is"])).experiment.quality.lacks
    changed = written(tmp_path, Form("x\n" + csv_text(RIGHT | {"t": 0.0 * RIGHT["t"]})))
    with pytest.raises(UsageError, match=r"\(head in line 2\): 99 of 100 rows"):
        open_recording(*changed)
