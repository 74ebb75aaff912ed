"""Arguments that several functions have: runs, names and values of parameters, numbers with a least value."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from emb_bench.config.bench import Bench
from emb_bench.logs.log import RunLog, read_log, require_driven
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError
from emb_runtime.system.terminal import mention

Source = RunLog | str | Path
Names = str | Sequence[str]


def opened(run: Source, map_path: str | Path | None = None) -> RunLog:
    """The log of a run; with a map, a recording of others."""
    if isinstance(run, RunLog):
        return run
    if map_path is None:
        from emb_bench.recordings.map_file import KINDS

        if Path(run).suffix.lower() in KINDS:
            raise UsageError(f"{run}: a recording of others needs its map file: --map FILE")
        return read_log(run)
    from emb_bench.recordings.recording import open_recording

    return open_recording(Path(run), Path(map_path))


def driven(run: Source, map_path: str | Path | None) -> RunLog:
    """As :func:`opened`, of a run in which something was driven."""
    log = opened(run, map_path)
    require_driven(log)
    return log


def listed(runs: Source | Sequence[Source]) -> list[Source]:
    """The runs one by one; UsageError if one comes twice, under whatever name."""
    found = [runs] if isinstance(runs, RunLog | str | Path) else list(runs)
    real = [os.path.realpath(run.path if isinstance(run, RunLog) else run) for run in found]
    if twice := [run for n, run in enumerate(found) if real[n] in real[:n]]:
        raise UsageError(f"{getattr(twice[0], 'path', twice[0])} comes twice: expected each run once")
    return found


def names_of(names: Names) -> tuple[str, ...]:
    """Names, or a text with commas between them."""
    listed = names.split(",") if isinstance(names, str) else names
    return tuple(name for entry in listed if (name := entry.strip()))


def unknowns(
    params: Names | None, nuisance: Names | None, bench: Bench | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Parameters and nuisances; those that are not given are the machine's of the bench, if it has one."""
    machine = None if bench is None else bench.machine
    default = (PARAMETER_NAMES, ()) if machine is None else (machine.unknown, machine.nuisances)
    return default[0] if params is None else names_of(params), default[1] if nuisance is None else names_of(nuisance)


def text_of(theta: str | Path | Mapping[str, float] | None) -> str:
    """Parameters as the option ``--theta`` has them."""
    if isinstance(theta, Mapping):
        return ",".join(f"{name}={float(value)!r}" for name, value in theta.items()) or "nominal"
    return "" if theta is None else str(theta)


def check(options: Mapping[str, tuple[int, int]]) -> None:
    """Check numbers against the least that each may be.

    Raises:
        UsageError: one is smaller.
    """
    for option, (value, least) in options.items():
        if value < least:
            raise UsageError(f"{option}: expected a number from {least}, got {value}")


def say(text: str) -> None:
    """Tell who waits at a terminal what takes the time."""
    if sys.stderr is not None and sys.stderr.isatty():
        mention(f"{text} ...")
