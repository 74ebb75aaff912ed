"""Agent A of Table 5.1: the trajectory reward (5.3.2) for 1 million steps."""

from __future__ import annotations

from emb_train.presets._thesis import RETURNING, SCALE, printed_hyper_parameters
from emb_train.rewards import TrajectoryReturn
from emb_train.training.configuration import Configuration

PRESET = Configuration(
    preset="thesis-trajectory-a",
    summary="viscous friction, back to the origin along a quintic, agent A",
    ranges="viscous",
    parameters=("f_v",),
    reward=TrajectoryReturn(scale=SCALE),
    ppo=printed_hyper_parameters(1_000_000),
    conditions=RETURNING,
)
