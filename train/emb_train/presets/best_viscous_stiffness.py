"""f_v and k_1 in the ranges of Table 6.1, E-optimal, home after 500 ms.

Measured with ``--steps 2000000``, seed 0, by ``emb-train evaluate DIR --last --criterion weighted --shield
viscous-stiffness --draws 500 --seed 1 --plant euler --ruler-draws 0``: 3.05e7 (95 % interval over draws 2.97e7 to
3.14e7), no violation, every run home; the best reference excitation, a constant speed that turns at 150 ms, 2.79e7. The
thesis's hybrid agent has 1.53e7. The 10 million steps of the preset were not measured.
"""

from __future__ import annotations

from emb_train.envs.conditions import Conditions
from emb_train.presets._own import own_hyper_parameters
from emb_train.rewards import EigenvalueIncrement
from emb_train.training.configuration import Configuration

PRESET = Configuration(
    preset="best-viscous-stiffness",
    summary="viscous friction and stiffness of Table 6.1; smallest eigenvalue of the weighted Fisher information",
    ranges="viscous-stiffness",
    parameters=("k_1", "f_v"),
    reward=EigenvalueIncrement(scale=3e-7),
    ppo=own_hyper_parameters(10_000_000),
    conditions=Conditions(shield_ranges="viscous-stiffness"),
)
