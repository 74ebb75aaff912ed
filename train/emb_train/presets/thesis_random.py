"""Random parameter initialisation (4.7.2, 5.2.3): f_v in [1, 5]e-5, full observation. Fig. 5.4, 5.5."""

from __future__ import annotations

from emb_train.presets._thesis import OBSERVED, SCALE, printed_hyper_parameters
from emb_train.rewards import PenalisedIncrement
from emb_train.training.configuration import Configuration

PRESET = Configuration(
    preset="thesis-random",
    summary="viscous friction drawn from the thesis's range, full observation",
    ranges="viscous",
    parameters=("f_v",),
    reward=PenalisedIncrement(scale=SCALE),
    ppo=printed_hyper_parameters(1_000_000),
    conditions=OBSERVED,
)
