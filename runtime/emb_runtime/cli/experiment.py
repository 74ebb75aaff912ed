"""One experiment with its ways home."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from emb_runtime.can.interfaces import open_transport
from emb_runtime.can.messages import StopReason
from emb_runtime.can.transport import Transport
from emb_runtime.cli.documents import refusal
from emb_runtime.cli.plan import Plan
from emb_runtime.cli.session import Bus, Console, conduct, observe
from emb_runtime.control.result import may_go_home
from emb_runtime.control.start_conditions import Bounds
from emb_runtime.errors import EXIT_DONE, EXIT_SAFETY_STOP, EmbError
from emb_runtime.records import HOMING_LOG, RunType
from emb_runtime.system.clock import Clock


def experiment(
    plan: Plan, path: Path, console: Console, opened: tuple[Transport, Clock] | None = None
) -> tuple[dict[str, Any], int]:
    """Run one experiment on a bus, with a way home before and after it where the plan has that and it is needed.

    The log must not exist; those of the ways home are called alike. A bus that is ``opened`` already stands for that of
    the plan, and is closed too.

    Returns:
        The document, see :meth:`emb_runtime.cli.documents.RunResult.document`; of the way home, where that failed
        before the experiment. And the exit code.

    Raises:
        RefusedError: the pre-flight or the operator refused; nothing was sent.
        UsageError: the log cannot be written; nothing was sent.
        BusError: the bus cannot be opened or watched, or was lost before anything was sent.
    """
    # The kernel keeps what is not in the DBC away: a babbling stranger must not cost the loop its period. Another
    # commander still shows, for he uses an identifier of the DBC; --read-only shows all that is on the bus.
    identifiers = tuple(message.identifier for message in plan.layout.all_messages)
    transport, clock = opened or open_transport(plan.iface, plan.bench, identifiers)
    bus = Bus(plan.iface, transport, clock)
    assert plan.experiment is not None
    home, homing = plan.experiment.home, dict[str, dict[str, Any]]()
    try:
        if home and (exit_code := _go_home(plan, bus, path, console, homing, "before")) != EXIT_DONE:
            return homing["before"], exit_code
        ran = conduct(plan, bus, RunType.EXPERIMENT, path, console)
        exit_code = ran.exit_code
        if home and may_go_home(ran.outcome) and not console.stop_requested():
            try:
                way_code = _go_home(plan, bus, path, console, homing, "after")
            except EmbError as err:  # the experiment counts, whatever fails here
                homing["after"], way_code = refusal(err, bus.iface), err.exit_code
            exit_code = exit_code or way_code
    finally:
        transport.close()
    return ran.document() | {"homing": homing}, exit_code


def _go_home(plan: Plan, bus: Bus, path: Path, console: Console, homing: dict[str, dict[str, Any]], when: str) -> int:
    """The way home before or after an experiment, if the brake is not at home; its document goes to ``homing``.

    Returns:
        Its exit code.
    """
    statistics = observe(plan, bus, plan.start_conditions(anywhere=True), console.stop_requested)
    sample, status = statistics.sample, statistics.status
    # The run may have ended before the node told why it stopped: the status is rarer than the samples.
    if when == "after" and status is not None and status.stop_reason is StopReason.LIMIT:
        return EXIT_SAFETY_STOP
    if sample is not None and Bounds(plan.bench).is_home(sample):  # without one the pre-flight refuses
        return EXIT_DONE
    log = path.with_name(f"{path.stem}-{when}{HOMING_LOG}{path.suffix}")
    way = conduct(plan, bus, RunType.HOMING, log, console)
    homing[when] = way.document()
    return way.exit_code
