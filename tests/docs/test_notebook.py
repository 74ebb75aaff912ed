"""The notebook runs from its first cell to its last and shows what it speaks of; so does the example beside it.

``jupyter execute --inplace examples/first_log.ipynb`` writes the outputs into it.
"""

from __future__ import annotations

import json
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


@pytest.mark.slow
def test_every_cell_of_the_notebook_runs(tmp_path: Path) -> None:
    notebook: Any = nbformat.read(NOTEBOOK, as_version=4)  # type: ignore[no-untyped-call]
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    pictures = [output for cell in cells for output in cell.outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 2
    assert "DONE complete" in cells[0].outputs[0].text
    assert cells[-1].outputs[0].text == "False\n"
    assert not any(output.get("name") == "stderr" for cell in cells for output in cell.outputs)


def test_its_outputs_are_stored_for_a_reader_without_python() -> None:
    cells = [cell for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] for cell in cells)


@pytest.mark.slow
def test_the_example_for_a_log_runs(tmp_path: Path) -> None:
    page = (NOTEBOOK.parents[1] / "docs" / "howto" / "read-a-log.md").read_text(encoding="utf-8")
    example, other = re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    example += other
    api.simulate(tmp_path / "run.mcap", duration=0.05)
    done = subprocess.run([sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("DONE True")
