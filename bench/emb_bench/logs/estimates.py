"""Estimates that are read: the running one of an experiment, by step, and one from its JSON document."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec

from emb_bench.logs.log import RunLog, once
from emb_runtime.config.bench import Systematic
from emb_runtime.errors import LogError, UsageError
from emb_runtime.estimator.estimate import LOST, UNKNOWN, by_name
from emb_runtime.log.topics import message_class
from emb_runtime.system.input_file import read_text
from emb_runtime.system.terminal import one_line

LOG = "log"  # Name of the last running estimate in the log
MAX_JSON_BYTES = 64 * 2**20  # Size limit of the JSON of an estimate or a report
LONG = 80  # Most characters shown of a text in it
Form = TypeVar("Form", bound=msgspec.Struct)
_STEP, *_ESTIMATE = message_class("Estimate").DESCRIPTOR.fields_by_name


def by_step(log: RunLog) -> dict[int, tuple[float, ...]]:
    """All estimates by their step, see :attr:`emb_runtime.estimator.estimator.Estimator.estimate`."""
    return {step: tuple(numbers) for step, *numbers in log.rows("/estimate", _STEP, *_ESTIMATE)}


@once
def last_estimate(log: RunLog) -> dict[str, dict[str, Any]]:
    """The estimate at the end by name, see :func:`emb_runtime.estimator.estimate.by_name`; empty if there was none."""
    lost = any(event.code == LOST for event in log.events)
    return {} if lost else by_name(log.last("/estimate", *_ESTIMATE), known_errors(log))


def known_errors(log: RunLog) -> Systematic:
    """Systematic errors by the bench file in a log; UNKNOWN where it has none that is readable."""
    try:
        return log.bench.systematic
    except LogError:
        return UNKNOWN


class _Report(msgspec.Struct, Generic[Form], frozen=True):
    estimate: Form | None = None


def read_document(path: str | Path, form: type[Form], source: str) -> Form:
    """The JSON of ``emb-replay estimate`` or, in a report, of ``emb-replay report``, as far as ``form`` has it.

    Raises:
        OSError: the file cannot be read.
        UsageError: it is no such document; the message begins with ``source``.
    """
    try:
        text = read_text(path, MAX_JSON_BYTES).encode()
        report = msgspec.json.decode(text, type=_Report[form])  # type: ignore[valid-type]
        return report.estimate or msgspec.json.decode(text, type=form)
    except (ValueError, msgspec.MsgspecError, RecursionError) as err:  # also UnicodeDecodeError
        why = "not UTF-8 text" if isinstance(err, UnicodeDecodeError) else one_line(str(err), LONG)
        raise UsageError(f"{source}: expected the JSON of an estimate or a report: {why}") from err
