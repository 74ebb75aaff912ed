"""All four parameters within 50 % of nominal, A-optimal: the physical information from a uniform prior on.

Measured with ``--steps 2000000``, seed 0, by ``emb-train evaluate DIR --last --criterion A --draws 500 --seed 1
--plant euler --ruler-draws 0``: 20.57 (95 % interval over draws 20.53 to 20.61), no violation, every run home; a
ramp has 20.30. The 10 million steps of the preset were not measured.
"""

from __future__ import annotations

from emb_train.presets._own import PHYSICAL, own_hyper_parameters
from emb_train.rewards import LogTrace
from emb_train.training.configuration import Configuration

PRESET = Configuration(
    preset="best-four-a",
    summary="all four parameters within 50 %; trace of the inverse of the physical Fisher information",
    ranges="pm50",
    parameters=("k_m", "k_1", "T_c", "f_v"),
    reward=LogTrace(scale=0.2),
    ppo=own_hyper_parameters(10_000_000),
    conditions=PHYSICAL,
)
