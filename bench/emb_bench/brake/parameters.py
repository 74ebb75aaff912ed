"""Parameters of a brake and its instruments that can be estimated from a record, by name and by index.

The thesis identifies k_m, k_1, T_c and f_v. The others are what the record depends on besides: nuisances that are
estimated along, or constants whose error has a price.
"""

from __future__ import annotations

from emb_runtime.config.bench import PARAMETER_NAMES

K_M = 0
K_1 = 1
T_C = 2
F_V = 3
J = 4
CONTACT = 5
DELAY = 6
X1_0 = 7
X2_0 = 8
OFFSET = 9
BREAK_AWAY = 10
STRIBECK_VELOCITY = 11
F_L = 12
QUADRATIC = 13
CUBIC = 14
HYSTERESIS = 15
CURRENT_LAG = 16
CURRENT_OFFSET = 17
VELOCITY_GAIN = 18
COULOMB_ASYMMETRY = 19
VISCOUS_ASYMMETRY = 20
PLAY = 21
COMMAND = 22
"""Current that is commanded in the period at hand, and in no other [A]: what is unknown where a report was lost."""
PAST_COMMAND = 23  # That current in the periods after it, in which it shows in the state alone

PARAMETERS = (
    *PARAMETER_NAMES,
    "J",
    "contact",
    "delay",
    "x1_0",
    "x2_0",
    "offset",
    "break_away",
    "stribeck_velocity",
    "f_l",
    "quadratic",
    "cubic",
    "hysteresis",
    "current_lag",
    "current_offset",
    "velocity_gain",
    "coulomb_asymmetry",
    "viscous_asymmetry",
    "play",
)

UNITS = {
    "contact": "rad",  # angle at which the clamping begins, nominally 0
    "delay": "samples",  # of the command
    "x1_0": "rad",  # angle and
    "x2_0": "rad/s",  # velocity at the start
    "offset": "rad",  # of the encoder: it shows x1 + offset
    "current_offset": "A",  # what acts beyond what the node reports
    "velocity_gain": "1",  # of the velocity sensor: it shows x2 (1 + velocity_gain)
    "coulomb_asymmetry": "1",  # T_c (1 ± it) in the positive and the negative direction
    "viscous_asymmetry": "1",  # f_v (1 ± it), likewise
}
"""Units of the unknowns whose sensitivity is absolute; the others are relative to their value, θ ∂/∂θ (eq. 4.17)."""

SI = UNITS | {
    "k_m": "N·m/A",
    "k_1": "N/rad",
    "T_c": "N·m",
    "f_v": "N·m·s/rad",
    "J": "kg·m²",
    "break_away": "1",  # static over Coulomb friction
    "stribeck_velocity": "rad/s",
    "f_l": "m",
    "quadratic": "1/rad",
    "cubic": "1/rad²",
    "hysteresis": "1",
    "current_lag": "s",
    "play": "rad",
}
"""Units of the values of all of them."""
