"""Parameters to evaluate a record at: nominal, true, given one by one, or of the JSON of an estimate."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import msgspec

from emb_bench.brake.parameters import SI, quantity
from emb_bench.config.bench import Bench
from emb_bench.experiment.simulate import NO_ERRORS, SystematicErrors
from emb_bench.logs.estimates import LOG, last_estimate, read_document
from emb_bench.logs.log import RunLog
from emb_bench.sim.simulated_brake import check_near_nominal, parse_assignments, true_parameters
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters
from emb_runtime.errors import LogError, UsageError, near


def read_theta(
    given: str | Path | Mapping[str, float] | None, log: RunLog | None, bench: Bench
) -> tuple[str, BrakeParameters, SystematicErrors]:
    """The name of the parameters to evaluate at, the parameters, and the systematic errors estimated with them.

    ``given`` is one of: values by name; a text ``name=value,name=value``; ``log`` for the last running estimate in the
    log; ``nominal``; ``true``; the file of an estimate or a report. The default is ``log``, or ``nominal`` without a
    running estimate. Parameters without a value are nominal. Planned currents have neither ``log`` nor ``true``.
    """
    if isinstance(given, Mapping):
        named = ",".join(f"{name}={value}" for name, value in given.items()) or "nominal"
        return named, true_parameters(bench, given, option="--theta: "), NO_ERRORS
    choice = "" if given is None else str(given)
    if log is not None and choice in ("", LOG):
        if values := _running(log, bench):
            return LOG, bench.brake._replace(**values), NO_ERRORS
        if choice:
            raise UsageError("--theta log: expected a running estimate in the log, and there is none")
    if choice in ("", "nominal"):
        return "nominal", bench.brake, NO_ERRORS
    if log is not None and choice == "true":
        if log.truth is None:
            raise UsageError("--theta true: only the log of a simulated brake has its true parameters")
        for name, value in log.truth._asdict().items():
            check_near_nominal(bench, name, value, "--theta true: ")
        return choice, log.truth, NO_ERRORS
    if "=" in choice:
        return choice, true_parameters(bench, parse_assignments(choice, "--theta: "), option="--theta: "), NO_ERRORS
    values, errors = _from_file(choice, log, bench)
    for name, value in values.items():
        check_near_nominal(bench, name, value, f"{choice}: ")
    return Path(choice).name, bench.brake._replace(**values), errors


def _running(log: RunLog, bench: Bench) -> dict[str, float]:
    """The last running estimate in a log; empty without one, or with an impossible value."""
    try:
        values = {name: float(entry["value"]) for name, entry in last_estimate(log).items() if name in PARAMETER_NAMES}
        for name, value in values.items():
            check_near_nominal(bench, name, value)
    except (LogError, UsageError):
        return {}
    return values


class _Value(msgspec.Struct, frozen=True):
    value: float


class _Record(msgspec.Struct, frozen=True):
    name: str


class _Estimate(msgspec.Struct, frozen=True):
    """An estimate, as far as a record is evaluated at it."""

    parameters: dict[str, float | _Value]
    systematic: dict[str, float | _Value] = {}
    records: tuple[_Record, ...] = ()


def _from_file(path: str, log: RunLog | None, bench: Bench) -> tuple[dict[str, float], SystematicErrors]:
    """Parameters in the document of an estimate or a report [SI], and systematic errors of the log there.

    Parameters and systematic errors trade off with each other: only together do they explain the record.
    """
    try:
        found = read_document(path, _Estimate, path)
    except OSError as err:
        choices = ("nominal",) if log is None else (LOG, "nominal", "true")
        expected = f"expected {', '.join(choices)}, name=value or a file{near(path, choices)}"
        raise UsageError(f"--theta: {expected}; {path}: {err.strerror}") from err
    names = PARAMETER_NAMES if bench.machine is None else (*PARAMETER_NAMES, "J")
    labels = {name: quantity(bench.machine, name).name for name in names}
    values = {name: _number(found.parameters[label]) for name, label in labels.items() if label in found.parameters}
    if not values:
        raise UsageError(f"{path}: expected an estimate of some of {', '.join(names)}, and it has none of them")
    return values, _errors(found, path, log, bench)


def _errors(found: _Estimate, path: str, log: RunLog | None, bench: Bench) -> SystematicErrors:
    """Systematic errors of a log in an estimate of some records; the encoder's offset is that of the record."""
    limits = {"current_offset": bench.limits.current, "delay": 1.0, "velocity_gain": 1.0}
    labels = {name: quantity(bench.machine, name).name for name in limits}
    records = [Path(record.name).name for record in found.records]
    if log is not None and log.path.name in records:
        limits["offset"] = bench.limits.angle[1] - bench.limits.angle[0]
        labels["offset"] = f"offset[{records.index(log.path.name)}]" if len(records) > 1 else "offset"
    values = {n: _number(found.systematic[label]) for n, label in labels.items() if label in found.systematic}
    for name, value in values.items():
        if not abs(value) < limits[name]:  # this way round, NaN is refused
            raise UsageError(f"{path}: {name}: expected less than {limits[name]:g} {SI[name]}, got {value!r}")
    return SystematicErrors(**values)


def _number(entry: float | _Value) -> float:
    return entry.value if isinstance(entry, _Value) else entry
