"""Decision on the current to send: the policy's, if finite, clipped, shielded, and within reach of the last command."""

from __future__ import annotations

import math
from typing import NamedTuple

from emb_runtime.records import Reason
from emb_runtime.safety.shield import LIMITED, Past, shield, window
from emb_runtime.safety.shield_design import ShieldLaw
from emb_runtime.safety.state_machine import Fault, StopError

CLIPPED, LEFT = int(Reason.CLIPPED), int(Reason.LEFT)  # an enumeration combines its members in Python

ROUNDING = 1e-6
"""Relative: single precision in the policy may pass its contract's limit by so much."""


class Reach(NamedTuple):
    """Limits of what may be sent, whatever the shield would need."""

    limit: float
    """Largest current: the bench's, or a narrower one that the operator asked for [A]."""
    slew: float
    """Largest change from one command to the next [A]."""


class Decision(NamedTuple):
    """Command made of a policy's wish, and the reasons for a change."""

    clipped: float
    """The wish within the limit [A]."""
    current: float
    """To be sent [A]; NaN: nothing is, and the node brakes in this period."""
    reasons: int
    """:class:`~emb_runtime.records.Reason` bits."""


def checked(wanted: float, contract_limit: float) -> float:
    """A policy's wish, if it is one at all.

    Finite is asked first: NaN passes ``min``, ``max`` and every comparison written the wrong way round.

    Args:
        wanted: what the policy answered [A].
        contract_limit: most that its contract allows it to ask for [A].

    Raises:
        StopError: it is not finite, or beyond the contract.
    """
    if not math.isfinite(wanted):
        raise StopError(Fault.POLICY_NOT_FINITE, f"it answered {wanted}")
    if abs(wanted) > contract_limit * (1.0 + ROUNDING):
        raise StopError(
            Fault.POLICY_BEYOND_CONTRACT, f"it asked for {wanted:g} A, its contract allows {contract_limit:g} A"
        )
    return wanted


def decide(
    law: ShieldLaw, reach: Reach, angle: float, velocity: float, wanted: float, past: Past, last: float, step: int
) -> Decision:
    """Decide what to send for a sample.

    The shield reckons with any current at once. Where it needs one that is out of reach, nothing is sent: the node
    then brakes with all it has, which the shield's argument allows in every period.

    Args:
        law: the shield's.
        reach: what may be sent.
        angle: newest measurement [rad].
        velocity: newest measurement [rad/s].
        wanted: from :func:`checked` [A].
        past: the last own commands, newest first [A].
        last: the command of the period before, 0 if there was none [A].
        step: index of the sample in the experiment.
    """
    clipped = min(max(wanted, -reach.limit), reach.limit)
    current, bits = shield(law, angle, velocity, clipped, past, step)
    if clipped != wanted:
        bits |= CLIPPED
    low, high = max(-reach.limit, last - reach.slew), min(reach.limit, last + reach.slew)
    if not low <= current <= high:
        held = min(max(current, low), high)
        lowest, highest = window(law, angle, velocity, past)
        if not lowest <= held <= highest:
            return Decision(clipped, math.nan, bits | LEFT)
        current, bits = held, bits | LIMITED
    return tuple.__new__(Decision, (clipped, current, bits))
