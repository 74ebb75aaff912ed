"""Way home: a run whose actor wants no current, so that the shield alone moves the brake."""

from __future__ import annotations

from emb_runtime.can.messages import StopReason
from emb_runtime.config.bench import Bench
from emb_runtime.control.result import Outcome
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.safety.state_machine import Fault

LONGEST_WAY = 3.0  # Time for a way home; from anywhere inside the limits it takes well below one [s]


class Still:
    """An actor that wants 0 A."""

    def act(self, angle: float, velocity: float, step: float, estimator: Estimator) -> float:
        """Return 0 A."""
        return 0.0


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


def homing_steps(bench: Bench) -> int:
    """Samples after which a way home is given up."""
    return round(LONGEST_WAY / bench.timing.sample_time)
