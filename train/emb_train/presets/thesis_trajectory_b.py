"""Agent B of Table 5.1: the trajectory reward (5.3.2) for 2 million steps. Fig. 5.8, 5.9."""

from __future__ import annotations

from emb_train.presets._thesis import RETURNING, SCALE, printed_hyper_parameters
from emb_train.rewards import TrajectoryReturn
from emb_train.training.configuration import Configuration

PRESET = Configuration(
    preset="thesis-trajectory-b",
    summary="viscous friction, back to the origin along a quintic, agent B",
    ranges="viscous",
    parameters=("f_v",),
    reward=TrajectoryReturn(scale=SCALE),
    ppo=printed_hyper_parameters(2_000_000),
    conditions=RETURNING,
)
