"""Decision on the current to send: the policy's, if finite, clipped, shielded, and within reach of the last command."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from emb_runtime.records import Reason
from emb_runtime.safety.shield import LIMITED, Past, shield, window
from emb_runtime.safety.shield_design import ShieldLaw
from emb_runtime.safety.state_machine import Fault, StopError

CLIPPED: Final = int(Reason.CLIPPED)  # an enumeration combines its members in Python
LEFT: Final = int(Reason.LEFT)

ROUNDING: Final = 1e-6  # Relative: single precision in the policy may pass its contract's limit by so much


class Reach(NamedTuple):
    """Limits of what may be sent, whatever the shield would need."""

    limit: float  # Largest current: the bench's, or a narrower one that the operator asked for [A]
    slew: float  # Largest change from one command to the next [A]


class Decision(NamedTuple):
    """Command made of a policy's wish, and the reasons for a change."""

    clipped: float  # The wish within the limit [A]
    current: float  # To be sent [A]; NaN: nothing is, and the node brakes in this period
    reasons: int  # :class:`~emb_runtime.records.Reason` bits


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


def shielded(
    law: ShieldLaw, angle: float, velocity: float, clipped: float, past: Past, step: int, low: float, high: float
) -> tuple[float, int]:
    """Current to send within given limits [A], NaN for none, and the :class:`~emb_runtime.records.Reason` bits.

    The shield reckons with any current at once. Where it needs one that is beyond the limits, the nearest within them
    is sent if it will do. Else nothing is: the node then brakes with all it has, which the shield's argument allows in
    every period.

    Args:
        law: this and the next five as for :func:`emb_runtime.safety.shield.shield`.
        angle: newest measurement [rad].
        velocity: newest measurement [rad/s].
        clipped: requested current [A].
        past: the last own commands, newest first [A].
        step: index of the sample in the experiment.
        low: least that may be sent [A].
        high: most that may be sent [A].
    """
    current, bits = shield(law, angle, velocity, clipped, past, step)
    if low <= current <= high:
        return current, bits
    held = min(max(current, low), high)
    lowest, highest = window(law, angle, velocity, past)
    if lowest <= held <= highest:
        return held, bits | LIMITED
    return math.nan, bits | LEFT


def decide(
    law: ShieldLaw, reach: Reach, angle: float, velocity: float, wanted: float, past: Past, last: float, step: int
) -> Decision:
    """Decide what to send for a sample.

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
    low, high = max(-reach.limit, last - reach.slew), min(reach.limit, last + reach.slew)
    current, bits = shielded(law, angle, velocity, clipped, past, step, low, high)
    if clipped != wanted:
        bits |= CLIPPED
    return tuple.__new__(Decision, (clipped, current, bits))
