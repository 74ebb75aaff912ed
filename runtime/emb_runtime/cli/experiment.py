"""One experiment with its ways home."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from emb_runtime.can.interfaces import open_transport
from emb_runtime.can.messages import StopReason
from emb_runtime.can.transport import Transport
from emb_runtime.cli.bus_monitor import BusStatistics
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
    """Run one experiment on a bus, and bring the brake home before and after it where that is asked for and needed.

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
    identifiers = tuple(message.identifier for message in plan.layout.known)
    transport, clock = opened or open_transport(plan.iface, plan.bench, identifiers)
    bus = Bus(plan.iface, transport, clock)
    assert plan.experiment is not None
    home = plan.experiment.home
    try:
        homing: dict[str, Any] = {}
        if home and _is_away(plan, _observe(plan, bus, console)):
            way = conduct(plan, bus, RunType.HOMING, _beside(path, "before"), console)
            homing["before"] = way.document()
            if way.exit_code != EXIT_DONE:
                return homing["before"], way.exit_code
        ran = conduct(plan, bus, RunType.EXPERIMENT, path, console)
        exit_code = ran.exit_code
        if home and may_go_home(ran.outcome) and not console.stop_requested():
            way_code = _go_home(plan, bus, path, console, homing)
            exit_code = exit_code or way_code
    finally:
        transport.close()
    return ran.document() | {"homing": homing}, exit_code


def _observe(plan: Plan, bus: Bus, console: Console) -> BusStatistics:
    """Bus statistics now, wherever the brake is."""
    return observe(plan, bus, plan.start_conditions(anywhere=True), console.stop_requested)


def _is_away(plan: Plan, statistics: BusStatistics) -> bool:
    """Returns True if the brake is not at home, or its place is unknown: the pre-flight of a way home says why."""
    return statistics.sample is None or not Bounds(plan.bench).is_home(statistics.sample)


def _go_home(plan: Plan, bus: Bus, path: Path, console: Console, homing: dict[str, Any]) -> int:
    """The way home after an experiment, if one is needed; its exit code. Whatever fails here, the experiment counts."""
    try:
        statistics = _observe(plan, bus, console)
        # The run may have ended before the node told why it stopped: the status is rarer than the samples.
        if statistics.status is not None and statistics.status.stop_reason is StopReason.LIMIT:
            return EXIT_SAFETY_STOP
        if not _is_away(plan, statistics):
            return EXIT_DONE
        way = conduct(plan, bus, RunType.HOMING, _beside(path, "after"), console)
    except EmbError as err:
        homing["after"] = refusal(err, bus.iface)
        return err.exit_code
    homing["after"] = way.document()
    return way.exit_code


def _beside(path: Path, when: str) -> Path:
    """The log of a way home."""
    return path.with_name(f"{path.stem}-{when}{HOMING_LOG}{path.suffix}")
