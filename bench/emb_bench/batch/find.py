"""Search for the logs of a campaign."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePath

from emb_bench.batch.row import Source
from emb_runtime.errors import UsageError
from emb_runtime.records import HOMING_LOG, LISTEN_ONLY_LOG

SUFFIX = ".mcap"
PASSED_OVER = (HOMING_LOG + SUFFIX, LISTEN_ONLY_LOG + SUFFIX)  # Logs of emb-run that hold no experiment


def find(paths: Sequence[Path]) -> list[Source]:
    """The logs in files and folders, sorted; one that is reached twice is taken once.

    A folder that cannot be listed, and what is called ``*.mcap`` and is no file, are in the list with their trouble.

    Args:
        paths: a file is a log whatever its name; a folder is searched for ``*.mcap``, with the folders in it, and
            ways home and mere listening are passed over.

    Raises:
        UsageError: a path does not exist, or there is no log in all of them.
    """
    found: list[Source] = []
    for path in sorted(set(paths), key=str):
        if path.is_dir():
            found += _inside(path)
        elif os.path.lexists(path):
            found.append(_source(path.parent, path, ""))
        else:
            raise UsageError(f"{path}: expected a log or a folder with logs, and there is none")
    seen: set[str] = set()
    logs = []
    for source in sorted(found, key=lambda s: (s.root, s.log)):
        real = os.path.realpath(source.path)
        if real not in seen:
            logs.append(source)
        seen.add(real)
    if not logs:
        raise UsageError(f"no *{SUFFIX} in {', '.join(map(str, paths))}")
    return logs


def _inside(root: Path) -> Iterator[Source]:
    """Follow links to folders as well, each folder once, so that a loop of them ends."""
    visited: set[str] = set()
    unlisted: list[OSError] = []
    for folder, folders, files in os.walk(root, onerror=unlisted.append, followlinks=True):
        real = os.path.realpath(folder)
        if real in visited:
            folders.clear()
            continue
        visited.add(real)
        folders.sort()
        for name in files:
            if name.lower().endswith(SUFFIX) and not name.lower().endswith(PASSED_OVER):
                yield _source(root, Path(folder, name), "")
    for err in unlisted:
        yield _source(root, Path(err.filename), f"the folder cannot be listed: {err.strerror}")


def _source(root: Path, path: Path, trouble: str) -> Source:
    relative = PurePath(os.path.relpath(path, root))
    if not trouble and path.exists() and not path.is_file():
        trouble = "expected a file, and it is none"  # opening a pipe would wait for ever
    return Source(str(path), str(root), relative.as_posix(), relative.parent.as_posix(), trouble)
