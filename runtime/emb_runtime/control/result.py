"""Result of a run: how it ended."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from emb_runtime.can.messages import StopReason
from emb_runtime.control.memory import RunCounters
from emb_runtime.records import SensorSample
from emb_runtime.safety.state_machine import Fault


@dataclass(frozen=True)
class Outcome:
    """Outcome of a run."""

    fault: Fault | None
    detail: str
    counters: RunCounters
    end: SensorSample | None  # Last sample in control; None of a run that never armed
    last: SensorSample | None  # Very last sample, after the stop frames
    home: bool  # The brake is home, and the run was complete
    node_at_rest: bool  # The node reported idle after the stop frames
    node_stop_reason: StopReason | None
    """Reason of the node's stop, by a status that came after the stop frames; None if none did. Of a run that never
    armed, the reason of the stop before."""
    duration_ns: int  # Time from the first sample to the last one in control, device time [ns]
    rejections: Mapping[str, Mapping[str, int]]  # Number of rejections by message name and reason; only what happened
    bus_errors: Mapping[str, int]  # Number of the CAN controller's reports by error; only what happened
    estimate: tuple[float, ...] = ()
    """Last :attr:`~emb_runtime.estimator.estimator.Estimator.estimate`; empty if there was none."""
    model_fits: bool = True  # The estimator's model explains the measurements
    unexplained: tuple[float, float] = (math.nan, math.inf)
    """Velocity that no one brake explains, see :mod:`emb_runtime.safety.motion_balance`, NaN of a run that was not
    completed; and what of it is allowed, infinite where nothing was judged [rad/s]."""
    response: str = ""  # How late the velocity follows the commands, and what is declared; "" if nothing was proven
    goal_ns: int | None = None
    """Time from the first sample to that at which the stop condition was met, device time [ns]; None if it was not."""

    @property
    def goal_reached(self) -> bool:
        """Returns True if the experiment ended early because the stop condition was met."""
        return self.goal_ns is not None

    def document(self) -> dict[str, Any]:
        """The outcome as plain data, for the log's trailer and for ``--json``; None for what there is not."""
        end, last, (unexplained, allowed) = self.end, self.last, self.unexplained
        judged = unexplained <= allowed < math.inf
        return {
            "duration_s": self.duration_ns * 1e-9,
            **asdict(self.counters),
            "rejections": dict(self.rejections),
            "bus_error_classes": dict(self.bus_errors),
            "model_fits": self.model_fits,
            "unexplained": unexplained if judged else None,
            "response": self.response or None,
            "unexplained_allowed": allowed if judged else None,
            "goal_reached": self.goal_reached,
            "goal_s": None if self.goal_ns is None else self.goal_ns * 1e-9,
            "home": self.home,
            "node_at_rest": self.node_at_rest,
            "node_stop_reason": self.node_stop_reason.name if self.node_stop_reason is not None else None,
            "end_angle": end.angle if end else None,
            "end_velocity": end.velocity if end else None,
            "node_state": last.node_state.name if last else None,
            "last_angle": last.angle if last else None,
        }


TRUSTED_AFTER = frozenset(
    {
        Fault.POLICY_NOT_FINITE,
        Fault.POLICY_BEYOND_CONTRACT,
        Fault.NOT_OBEYED,
        Fault.SENSOR_LOST,
        Fault.NODE_STOPPED,
        Fault.INCOMPLETE,
    }
)
"""Faults after which brake, drive and bus are as they were: the policy or this computer's timing was at fault.
After the others a person should look before anything moves again."""


def may_go_home(outcome: Outcome) -> bool:
    """Returns True if the brake may move by itself after such a run, once the node has come to rest."""
    return outcome.node_stop_reason is not StopReason.LIMIT and (
        outcome.fault is None or outcome.fault in TRUSTED_AFTER
    )
