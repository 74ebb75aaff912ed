"""Executes the notebook of examples/ from its first cell to its last.

``python -m tools.notebook`` writes the outputs into it.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[1] / "examples" / "first_log.ipynb"
TIMEOUT = 600  # Longest time of a cell [s]


def executed(path: Path, folder: Path) -> Any:
    """A notebook with its outputs.

    Args:
        path: of the notebook.
        folder: working directory.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell fails.
    """
    notebook: Any = nbformat.read(path, as_version=4)  # type: ignore[no-untyped-call]
    NotebookClient(notebook, timeout=TIMEOUT, resources={"metadata": {"path": str(folder)}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # times of day
    return notebook


def main() -> int:
    """Write the outputs anew."""
    nbformat.write(executed(NOTEBOOK, NOTEBOOK.parent), NOTEBOOK)  # type: ignore[no-untyped-call]
    return 0


if __name__ == "__main__":
    sys.exit(main())
