"""Trajectory and adaptive reward together (6.3.2, eq. 6.6), E-optimal: f_v and k_1, 5 million steps. Fig. 6.3."""

from __future__ import annotations

from emb_train.presets._thesis import RETURNING, SCALE, printed_hyper_parameters
from emb_train.rewards import HybridReturn
from emb_train.training.configuration import Configuration

PRESET = Configuration(
    preset="thesis-e-optimal-hybrid",
    summary="viscous friction and stiffness, E-optimal, quintic then eq. 6.6",
    ranges="viscous-stiffness",
    parameters=("k_1", "f_v"),
    reward=HybridReturn(scale=SCALE),
    ppo=printed_hyper_parameters(5_000_000),
    conditions=RETURNING,
)
