"""Output of a command: results on standard output, errors in one line on standard error."""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
from typing import Any

from emb_runtime.errors import EmbError, UsageError


def show(text: str) -> None:
    """Print a result; a reader that has had enough (``| head``) is no error.

    Raises:
        UsageError: standard output takes nothing: it is closed, or the disk behind it is full.
    """
    if sys.stdout is None:  # closed before the program began
        raise UsageError("the result cannot be written to standard output: it is closed")
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        # Nothing may be written to the pipe at exit either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as err:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise UsageError(f"the result cannot be written to standard output: {err.strerror}") from err


def mention(text: str) -> None:
    """Say how things go, on standard error; nobody need hear it."""
    if sys.stderr is not None:  # closed before the program began
        with contextlib.suppress(OSError):
            sys.stderr.write(text + "\n")
            sys.stderr.flush()


def complain(command: str, err: EmbError) -> int:
    """Say in one line what went wrong, and give the exit code for it."""
    line = " ".join(str(err).split())
    if sys.stderr is not None:  # closed before the program began
        sys.stderr.write(f"{command}: {line}\n")
        sys.stderr.flush()
    return err.exit_code


def as_json(document: Any) -> str:
    """A document as one line of JSON; a number that is not finite is null, for JSON has no such numbers."""
    return json.dumps(_finite(document), allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
