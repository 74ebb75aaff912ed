"""D-optimal rewards, method 1 (eq. 6.4): f_v and k_1 of Table 6.1, 300 ms. Fig. 6.1."""

from __future__ import annotations

from emb_train.presets._thesis import BLIND, printed_hyper_parameters
from emb_train.rewards import DeterminantGain
from emb_train.training.configuration import Configuration

PRESET = Configuration(
    preset="thesis-d-optimal-1",
    summary="viscous friction and stiffness, D-optimal, amplified",
    ranges="viscous-stiffness",
    parameters=("k_1", "f_v"),
    reward=DeterminantGain(scale=1e-5),
    ppo=printed_hyper_parameters(1_000_000),
    conditions=BLIND,
)
