"""The trajectory reward with the smallest eigenvalue (6.3.1): f_v and k_1, 500 ms, 5 million steps. Fig. 6.2."""

from __future__ import annotations

from emb_train.presets._thesis import RETURNING, SCALE, printed_hyper_parameters
from emb_train.rewards import TrajectoryReturn
from emb_train.training.configuration import Configuration

PRESET = Configuration(
    preset="thesis-e-optimal-trajectory",
    summary="viscous friction and stiffness, E-optimal, along a quintic",
    ranges="viscous-stiffness",
    parameters=("k_1", "f_v"),
    reward=TrajectoryReturn(scale=SCALE),
    ppo=printed_hyper_parameters(5_000_000),
    conditions=RETURNING,
)
