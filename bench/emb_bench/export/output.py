"""Files that a command makes: never over another one, and never half of one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from emb_runtime.errors import UsageError


@contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """A file that did not exist, open for writing; it is removed again if writing it fails in any way.

    Raises:
        UsageError: something of that name exists, or it cannot be written.
    """
    try:
        file = path.open("x+b")
    except FileExistsError as err:
        raise UsageError(f"{path}: exists, and nothing is overwritten: choose another name") from err
    except OSError as err:
        raise UsageError(f"{path}: cannot write: {err.strerror}") from err
    try:
        with file:
            yield file
    except OSError as err:
        path.unlink(missing_ok=True)
        raise UsageError(f"{path}: cannot write: {err.strerror or err}") from err
    except BaseException:
        path.unlink(missing_ok=True)
        raise
