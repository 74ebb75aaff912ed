"""JSON schemas of the files that a user writes, by which an editor completes and checks them while they are typed.

``python -m tools.shipped_files`` makes them from the records that read these files, which check more than a schema can.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path

SCHEMAS = ("bench", "mapping", "map", "acceptance")  # Kinds of files


def schema_file(kind: str) -> str:
    """Name of the schema of a kind of files."""
    return f"{kind}.schema.json"


def write_schemas(folder: Path, *kinds: str) -> None:
    """Write the schemas of some kinds of files into a folder, of all if none is named; they replace older ones.

    There the first line of a file, ``#:schema ./bench.schema.json``, leads an editor to its schema.

    Raises:
        OSError: the folder is not there, or cannot be written.
    """
    for kind in kinds or SCHEMAS:
        name = schema_file(kind)
        (folder / name).write_bytes(resources.files("emb_runtime.config").joinpath(name).read_bytes())
