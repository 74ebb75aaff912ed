"""Fixed parameter initialisation (4.7.1, 5.2.2): nominal f_v, the actor sees everything, 300 ms. Fig. 5.2, 5.3."""

from __future__ import annotations

from emb_train.presets._thesis import OBSERVED, SCALE, printed_hyper_parameters
from emb_train.rewards import PenalisedIncrement
from emb_train.training.configuration import Configuration

PRESET = Configuration(
    preset="thesis-fixed",
    summary="viscous friction, fixed at its nominal value, full observation",
    ranges="nominal",
    parameters=("f_v",),
    reward=PenalisedIncrement(scale=SCALE),
    ppo=printed_hyper_parameters(1_000_000),
    conditions=OBSERVED,
)
