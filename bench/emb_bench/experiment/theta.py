"""Parameters to evaluate a record at: nominal, true, given one by one, or of the JSON of an estimate."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from emb_bench.brake.parameters import SI, Quantity, quantity
from emb_bench.config.bench import Bench
from emb_bench.experiment.evaluation import NO_ERRORS, SystematicErrors
from emb_bench.logs.estimates import last_estimate
from emb_bench.logs.log import RunLog
from emb_bench.sim.simulated_brake import check_near_nominal, parse_assignments, true_parameters
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters
from emb_runtime.config.typed import shown
from emb_runtime.errors import LogError, UsageError, near
from emb_runtime.system.input_file import read_text

LOG = "log"  # Name of the last running estimate in the log
MAX_JSON_BYTES = 64 * 2**20  # Size limit of the JSON of an estimate or a report


def read_theta(choice: str, log: RunLog, bench: Bench) -> tuple[str, BrakeParameters, SystematicErrors]:
    """The name of the parameters to evaluate at, the parameters, and the systematic errors estimated with them.

    The choice is ``log`` for the last running estimate in the log, empty for that or nominal where there is none,
    ``nominal``, ``true``, ``name=value,name=value``, or the JSON of an estimate or a report; the others are nominal.
    """
    if choice in ("", LOG):
        values = _running(log, bench)
        if values:
            return LOG, bench.brake._replace(**values), NO_ERRORS
        if choice:
            raise UsageError("--theta log: expected a running estimate in the log, and there is none")
    if choice in ("", "nominal"):
        return "nominal", bench.brake, NO_ERRORS
    if choice == "true":
        if log.truth is None:
            raise UsageError("--theta true: this log does not know the brake's true parameters, only a simulated one's")
        for name, value in log.truth._asdict().items():
            check_near_nominal(bench, name, value, "--theta true: ")
        return choice, log.truth, NO_ERRORS
    if "=" in choice:
        given = parse_assignments(choice, "--theta: ")
        return choice, true_parameters(bench, given, option="--theta: "), NO_ERRORS
    values, errors = _from_file(choice, log, bench)
    for name, value in values.items():
        check_near_nominal(bench, name, value, f"{choice}: ")
    return Path(choice).name, bench.brake._replace(**values), errors


def _running(log: RunLog, bench: Bench) -> dict[str, float]:
    """The last running estimate in a log; empty without one, or where a value can be no brake's."""
    try:
        values = {name: float(entry["value"]) for name, entry in last_estimate(log).items() if name in PARAMETER_NAMES}
        for name, value in values.items():
            check_near_nominal(bench, name, value)
    except (LogError, UsageError):
        return {}
    return values


def _from_file(path: str, log: RunLog, bench: Bench) -> tuple[dict[str, float], SystematicErrors]:
    """Parameters in a file, and systematic errors that were estimated with them."""
    try:
        return _estimated(json.loads(read_text(path, MAX_JSON_BYTES)), log, bench)
    except OSError as err:
        hint = near(path, ("log", "nominal", "true"))
        expected = f"expected log, nominal, true, name=value or a file{hint}"
        raise UsageError(f"--theta: {expected}; {path}: {err.strerror}") from err
    except UnicodeDecodeError as err:
        raise UsageError(f"{path}: expected JSON: not UTF-8 text") from err
    except json.JSONDecodeError as err:
        raise UsageError(f"{path}: expected the JSON of an estimate or a report, and it is no JSON: {err}") from err
    except (ValueError, RecursionError) as err:
        raise UsageError(f"{path}: {err}") from err


def _estimated(found: Any, log: RunLog, bench: Bench) -> tuple[dict[str, float], SystematicErrors]:
    """Parameters in the document of an estimate or a report [SI], and systematic errors of a log there.

    Parameters and systematic errors trade off with each other: only together do they explain the record.

    Raises:
        ValueError: it is no such document.
    """
    if isinstance(found, dict) and isinstance(found.get("estimate"), dict):
        found = found["estimate"]
    parameters = found.get("parameters") if isinstance(found, dict) else None
    if not isinstance(parameters, dict):
        raise ValueError("expected the JSON of 'emb-replay estimate --json' or of a report, and it is none")
    names = PARAMETER_NAMES if bench.machine is None else (*PARAMETER_NAMES, "J")
    known = _named(parameters, {name: quantity(bench.machine, name) for name in names}, "a positive number")
    if not known:
        raise ValueError(f"expected an estimate of some of {', '.join(names)}, and it has none of them")
    along = found.get("systematic")
    return known, NO_ERRORS if not isinstance(along, dict) else _errors(along, _names(found.get("records")), log, bench)


def _errors(along: Mapping[str, Any], records: list[str], log: RunLog, bench: Bench) -> SystematicErrors:
    """Systematic errors of a log in an estimate of some records; the encoder's offset is each record's own."""
    limits = {"current_offset": bench.limits.current, "delay": 1.0, "velocity_gain": 1.0}
    labels = {name: Quantity(quantity(bench.machine, name).name, "", 1.0) for name in limits}
    if log.path.name in records:
        own = f"[{records.index(log.path.name)}]" if len(records) > 1 else ""
        limits["offset"] = bench.limits.angle[1] - bench.limits.angle[0]
        labels["offset"] = Quantity(f"offset{own}", "", 1.0)
    values = _named(along, labels, "a number")
    for name, value in values.items():
        if not abs(value) < limits[name]:  # this way round, NaN is refused
            raise ValueError(f"{name}: expected less than {limits[name]:g} {SI[name]}, got {value!r}")
    return SystematicErrors(**values)


def _names(records: Any) -> list[str]:
    """File names of the records of an estimate; none where the document has no list of them."""
    listed = records if isinstance(records, list) else []
    return [Path(str(record["name"])).name for record in listed if isinstance(record, dict) and "name" in record]


def _named(entries: Mapping[str, Any], labels: Mapping[str, Quantity], expected: str) -> dict[str, float]:
    """Values of a table of the document, by our names [SI]: numbers, or tables with a ``value``, by label."""
    found = {}
    for name, label in labels.items():
        if label.name in entries:
            entry = entries[label.name]
            value = entry.get("value") if isinstance(entry, dict) else entry
            found[name] = _number(value, label.name, expected) / label.factor
    return found


def _number(value: object, name: str, expected: str) -> float:
    """A number of a file."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name}: expected {expected}, got {shown(value)}")
    return float(value)
