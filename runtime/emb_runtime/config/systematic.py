"""Systematic errors that a bench cannot exclude by itself: the ``[systematic]`` table of a bench file.

They are standard deviations of Gaussian priors with mean zero, or with what the plant itself says. What a record tells
better than its prior, as most records do, follows from the record. 0 excludes an error: the bench knows better.
"""

from __future__ import annotations

from dataclasses import dataclass

from emb_runtime.config.typed import NotNegative


@dataclass(frozen=True)
class Systematic:
    """Standard deviations before any record, of what is estimated along and of what may be wrong with the plant."""

    offset: NotNegative = 0.05  # Reading of the encoder at the true origin [rad]
    current_offset: NotNegative = 0.05
    """Current that acts beyond what the node reports; a friction that depends on the direction looks the same [A]."""
    delay: NotNegative = 0.3  # By which commands act late, or samples early [samples]
    velocity_gain: NotNegative = 0.02  # Relative error of the velocity's scale
    held: NotNegative = 0.02  # Relative error of each parameter that is held at its nominal value
    quadratic: NotNegative = 1e-4  # Quadratic share of the stiffness that the plant lacks [1/rad]
    cubic: NotNegative = 1e-6  # Cubic share of the stiffness that the plant lacks [1/rad²]
    hysteresis: NotNegative = 1e-2  # Hysteresis of the clamping force that the plant lacks
    play: NotNegative = 0.2  # Clearance in the gear [rad]
    break_away: NotNegative = 0.1  # Static friction beyond the plant's, as a share of T_c
    f_l: NotNegative = 1e-7  # Load-dependent static friction beyond the plant's [m]
    current_lag: NotNegative = 5e-4  # Time constant of the current loop beyond the plant's [s]
    drift: NotNegative = 0.003  # Change of each parameter from the begin of a run to its end, as a share of it
