"""Sequences of currents for a policy: an excitation, a design, a CSV file from another program."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from emb_bench.config.bench import Bench
from emb_bench.excitation import parse_excitation
from emb_bench.information.symmetric import Floats
from emb_runtime.errors import UsageError
from emb_runtime.system.input_file import decode, read_bytes

MOST_BYTES = 64 << 20  # Of a CSV file
UNITS = {"current": "A", "time": "s"}
HEAD = re.compile(r"(\w+?)(?:\s*[\[(]\s*(\S*?)\s*[\])]|_(m?A|m?s))?")
"""A column: its name, and its unit in brackets or after an underscore."""
EXPECTED = "expected a first line 'current' or 'time,current', then numbers [A], [s]"


def read_sequence(text: str, bench: Bench) -> tuple[Floats, str]:
    """The currents [A], shape [horizon], of an excitation or of a ``.csv`` file; and their name.

    Raises:
        UsageError: there is no such excitation or file, it is for another bench, or it is a feedback law.
    """
    if (path := Path(text)).suffix.lower() == ".csv":
        try:
            content = decode(read_bytes(path, MOST_BYTES))
        except (OSError, UnicodeDecodeError) as err:
            why = err.strerror if isinstance(err, OSError) else "its encoding is none of UTF-8, UTF-16 and cp1252"
            raise UsageError(f"{path}: cannot read the currents: {why}") from err
        if not content.startswith("# {"):
            return read_profile(content, path, bench)
        from emb_bench.design.report import read_design  # scipy takes its time

        return read_design(path, bench)
    excited = parse_excitation(text, bench)
    if excited.currents is None:
        raise UsageError(f"{excited.name} is a feedback law: expected an excitation that is a sequence of currents")
    return excited.currents, excited.text


def read_profile(text: str, path: Path, bench: Bench) -> tuple[Floats, str]:
    """Currents [A], shape [horizon], of a table of currents, or of times and currents; and a text on all changes.

    Without times each row lasts one sample period, and 0 A follows the last row. With times a row lasts until the next
    one, the last row until the end. A current beyond the bench's limit is clipped.
    """
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    if len(lines) < 2:
        raise UsageError(f"{path}: {EXPECTED}; it has no rows")
    delimiter = next((mark for mark in (";", "\t") if mark in lines[0][1]), ",")
    names = _names(path, _cells(lines[0][1], delimiter))
    rows = np.array([_row(path, n, line, delimiter, names) for n, line in lines[1:]])
    current, what = rows[:, names.index("current")], f"{len(rows)} rows of {path.name}"
    if "time" not in names:
        return limited(current, bench, what)
    times, period, horizon = rows[:, names.index("time")], bench.timing.sample_time, bench.timing.horizon
    if times[0] != 0.0 or (np.diff(times) < period * (1.0 - 1e-6)).any():
        raise UsageError(f"{path}: time: expected 0 s first, and rows at least one sample period of {period:g} s apart")
    if times[-1] > (horizon - 0.5) * period:
        raise UsageError(f"{path}: time: expected less than the horizon of {horizon * period:g} s, got {times[-1]:g} s")
    begins = period * (np.arange(horizon) + 1e-6)
    sampled = current[np.searchsorted(times, begins, side="right") - 1]
    return limited(sampled, bench, f"{what}, the last from {times[-1]:g} s to the end")


def limited(currents: Floats, bench: Bench, what: str) -> tuple[Floats, str]:
    """Currents [A] for each sample of the horizon, within the limit; and a text on all changes.

    Raises:
        UsageError: there is no current, or there are more than the horizon has.
    """
    horizon, limit = bench.timing.horizon, bench.limits.current
    if not 1 <= len(currents) <= horizon:
        raise UsageError(f"{what}: expected 1 to {horizon} currents, as the bench's horizon, got {len(currents)}")
    if len(currents) < horizon:
        what += f", 0 A from {len(currents) * bench.timing.sample_time:g} s on"
    if beyond := int((np.abs(currents) > limit).sum()):
        what += f"; {beyond} currents are beyond {limit:g} A: clipped"
    return np.clip(np.pad(currents, (0, horizon - len(currents))), -limit, limit), what


def _names(path: Path, heads: list[str]) -> list[str]:
    """Names of the columns; those that are not ours are empty."""
    names = []
    for head in heads:
        match = HEAD.fullmatch(head.strip())
        name = match[1].lower() if match else ""
        if match and name in UNITS and (unit := match[2] or match[3] or UNITS[name]) != UNITS[name]:
            raise UsageError(f"{path}: {name} in {unit!r:.20}: expected {UNITS[name]}")
        names.append(name if name in UNITS else "")
    if names.count("current") != 1 or names.count("time") > 1:
        raise UsageError(f"{path}: {EXPECTED}; got {','.join(heads)!r:.60}")
    return names


def _row(path: Path, line: int, text: str, delimiter: str, names: list[str]) -> list[float]:
    cells = _cells(text, delimiter)
    if len(cells) != len(names):
        hint = "; write numbers with a point" if len(cells) > len(names) and delimiter == "," else ""
        raise UsageError(f"{path}: line {line}: expected {len(names)} numbers, got {len(cells)}{hint}")
    row = []
    for cell, name in zip(cells, names, strict=True):
        try:
            value = float(cell.replace("_", "?")) if name else 0.0
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            hint = "; write numbers with a point" if "," in cell else ""
            raise UsageError(f"{path}: line {line}: {name}: expected a number, got {cell!r:.30}{hint}")
        row.append(value)
    return row


def _cells(line: str, delimiter: str) -> list[str]:
    return [cell.strip().strip('"') for cell in line.split(delimiter)]
