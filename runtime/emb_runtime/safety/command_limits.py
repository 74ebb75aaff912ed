"""Current to send: the policy's request, clipped, shielded, and limited in its change."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from emb_runtime.records import Reason
from emb_runtime.safety.shield import LIMITED, Past, shield, window
from emb_runtime.safety.shield_design import ShieldLaw
from emb_runtime.safety.state_machine import Fault, StopError

CLIPPED: Final = int(Reason.CLIPPED)
LEFT: Final = int(Reason.LEFT)

ROUNDING: Final = 1e-6  # Relative: single precision in the policy may pass its contract's limit by so much


class CommandLimits(NamedTuple):
    """Limits of what may be sent, whatever the shield would need."""

    current: float  # Largest current: the bench's, or a narrower one of the operator's [A]
    slew: float  # Largest change from one command to the next [A]


class Decision(NamedTuple):
    """Command made of a request, and the reasons for a change."""

    requested: float  # By the policy [A]
    clipped: float  # The request within the limit [A]
    current: float  # To be sent [A]; NaN: nothing is, and the node brakes in this period
    reasons: int  # :class:`~emb_runtime.records.Reason` bits


def checked(requested: float, contract_limit: float) -> float:
    """The policy's request [A]; raises StopError if it is not finite, or beyond its contract.

    Finite comes first: NaN passes ``min``, ``max`` and every comparison written the wrong way round.
    """
    if not math.isfinite(requested):
        raise StopError(Fault.POLICY_NOT_FINITE, f"it answered {requested}")
    if abs(requested) > contract_limit * (1.0 + ROUNDING):
        detail = f"it requested {abs(requested) / contract_limit:g} times what its contract allows"
        raise StopError(Fault.POLICY_BEYOND_CONTRACT, detail)
    return requested


def shielded(
    law: ShieldLaw, angle: float, velocity: float, clipped: float, past: Past, step: int, low: float, high: float
) -> tuple[float, int]:
    """Current to send, NaN for none [A], and the :class:`~emb_runtime.records.Reason` bits.

    The shield reckons with any current at once. Where it needs one beyond ``low`` and ``high`` [A], the nearest within
    them is sent if it lies in the shield's window. Else nothing is: the node then brakes with all it has, which the
    shield's argument allows in every period. The other arguments are those of
    :func:`emb_runtime.safety.shield.shield`.
    """
    current, bits = shield(law, angle, velocity, clipped, past, step)
    if low <= current <= high:
        return current, bits
    nearest = min(max(current, low), high)
    lowest, highest = window(law, angle, velocity, past)
    if lowest <= nearest <= highest:
        return nearest, bits | LIMITED
    return math.nan, bits | LEFT


def decide(
    law: ShieldLaw,
    limits: CommandLimits,
    angle: float,
    velocity: float,
    requested: float,
    past: Past,
    last: float,
    step: int,
) -> Decision:
    """Decide what to send for a sample.

    Args:
        law: the shield's.
        limits: of the command.
        angle: newest measurement [rad].
        velocity: newest measurement [rad/s].
        requested: from :func:`checked` [A].
        past: the last commands, newest first [A].
        last: the command of the period before, 0 if there was none [A].
        step: index of the sample in the experiment.
    """
    clipped = min(max(requested, -limits.current), limits.current)
    low, high = max(-limits.current, last - limits.slew), min(limits.current, last + limits.slew)
    current, bits = shielded(law, angle, velocity, clipped, past, step, low, high)
    if clipped != requested:
        bits |= CLIPPED
    return tuple.__new__(Decision, (requested, clipped, current, bits))
