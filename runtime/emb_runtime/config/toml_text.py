"""TOML that nobody vouches for, read within bounds of time and memory."""

from __future__ import annotations

import tomllib
from typing import Any

MAX_TOML_BYTES = 64 * 1024  # A bench file has a few KiB
MAX_DOTS = 500  # Most dots in a line: for a key of n parts tomllib takes time and memory that grow with n²
_MARK = "\ufeff"


def parse_toml(text: str) -> dict[str, Any]:
    """The document.

    Raises:
        ValueError: the text is not TOML, or too large; the message says what is wrong with it.
    """
    if text.startswith(_MARK):
        raise ValueError("it begins with a byte-order mark: save it as UTF-8 without one")
    if len(text) > MAX_TOML_BYTES:
        raise ValueError(f"expected at most {MAX_TOML_BYTES} characters, got {len(text)}")
    for number, line in enumerate(text.split("\n"), 1):
        if (dots := line.count(".")) > MAX_DOTS:
            raise ValueError(f"line {number}: expected at most {MAX_DOTS} dots, got {dots}")
    try:
        return tomllib.loads(text)
    except RecursionError as err:
        raise ValueError("not valid TOML: nested too deeply") from err
    except ValueError as err:  # TOMLDecodeError, and what tomllib lets through
        raise ValueError(f"not valid TOML: {err}") from err
