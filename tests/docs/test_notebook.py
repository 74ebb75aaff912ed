"""The notebook runs from its first cell to its last and shows what is stored in it; so does the example beside it.

``python -m tests.docs.test_notebook`` writes the outputs into it.
"""

from __future__ import annotations

import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

from emb_bench import api

NOTEBOOK = Path(__file__).parents[2] / "examples" / "first_log.ipynb"
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+\.?\d*(?:e[-+]?\d+)?(?!\w)")
CLOSE = 2e-3  # Relative tolerance: of the last digits that are printed; the intervals once were wrong by 2 %


def stored() -> Any:
    return nbformat.read(NOTEBOOK, as_version=4)  # type: ignore[no-untyped-call]


def executed(folder: Path, cells: int = 10**9) -> Any:
    notebook = stored()
    del notebook.cells[cells:]
    where = {"metadata": {"path": str(folder)}}
    return NotebookClient(notebook, timeout=600, record_timing=False, resources=where).execute()


def code_of(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def texts(cell: Any) -> list[tuple[str, str]]:
    """What a cell shows, without its pictures: the kind of each output and its text."""
    found = [(o.output_type, kind, text) for o in cell.outputs for kind, text in sorted(o.get("data", {}).items())]
    streams: dict[str, str] = {}  # a busy kernel sends one in several parts
    for output in cell.outputs:
        if "text" in output:
            streams[output.name] = streams.get(output.name, "") + output.text
    found += [("stream", name, text) for name, text in streams.items()]
    return [(f"{output} {kind}", "a picture" if kind.startswith("image/") else text) for output, kind, text in found]


def same(ours: str, theirs: str) -> bool:
    """Whether texts are the same, but for a little of each number."""
    numbers = [list(map(float, NUMBER.findall(text))) for text in (ours, theirs)]
    if NUMBER.sub("#", ours).split() != NUMBER.sub("#", theirs).split():
        return False
    return all(math.isclose(a, b, rel_tol=CLOSE, abs_tol=1e-12) for a, b in zip(*numbers, strict=True))


@pytest.mark.parametrize("cells", [10, pytest.param(10**9, marks=pytest.mark.slow)], ids=["up to the bounds", "all"])
def test_every_cell_shows_what_is_stored_for_a_reader_without_python(cells: int, tmp_path: Path) -> None:
    before, after = code_of(stored()), code_of(executed(tmp_path, cells))
    assert [cell.execution_count for cell in before] == list(range(1, len(before) + 1))
    assert len(after) == (5 if cells == 10 else len(before))
    for old, new in zip(before, after, strict=False):
        assert [kind for kind, _ in texts(old)] == [kind for kind, _ in texts(new)]
        for (_, ours), (_, theirs) in zip(texts(old), texts(new), strict=True):
            assert same(ours, theirs), f"{ours}\n{theirs}"
    shown = [entry for cell in before for entry in texts(cell)]
    assert not any("stderr" in kind for kind, _ in shown)
    assert sum(text == "a picture" for _, text in shown) == 3


def test_a_text_is_the_same_up_to_the_last_digits_of_its_numbers() -> None:
    text = "k_m: 0.0216999 to 0.0217001 (95 %)"
    assert same(text, "k_m: 0.0217 to 0.02170 (95 %)")
    for other in ("k_m: 0.0212563 to 0.0221436 (95 %)", "k_1: 0.0216999 to 0.0217001 (95 %)", f"{text} 1", ""):
        assert not same(text, other)


@pytest.mark.slow
def test_the_example_for_a_log_runs(tmp_path: Path) -> None:
    page = (NOTEBOOK.parents[1] / "docs" / "howto" / "read-a-log.md").read_text(encoding="utf-8")
    example, other = re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    example += other
    api.simulate(tmp_path / "run.mcap", duration=0.05)
    done = subprocess.run([sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("DONE True")


if __name__ == "__main__":
    nbformat.write(executed(NOTEBOOK.parent), NOTEBOOK)  # type: ignore[no-untyped-call]
