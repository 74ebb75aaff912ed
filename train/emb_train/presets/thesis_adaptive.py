"""The adaptive reward (eq. 5.15) with the asymmetric actor and critic of Table 4.2, 500 ms. Fig. 5.6."""

from __future__ import annotations

from emb_train.presets._thesis import RETURNING, SCALE, printed_hyper_parameters
from emb_train.rewards import AdaptiveReturn
from emb_train.training.configuration import Configuration

PRESET = Configuration(
    preset="thesis-adaptive",
    summary="viscous friction, back to the origin by the adaptive reward",
    ranges="viscous",
    parameters=("f_v",),
    reward=AdaptiveReturn(scale=SCALE),
    ppo=printed_hyper_parameters(1_000_000),
    conditions=RETURNING,
)
