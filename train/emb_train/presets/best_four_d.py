"""All four parameters within 50 % of nominal, D-optimal: the physical information from a uniform prior on.

Measured with ``--steps 2000000``, seed 0, by ``emb-train evaluate DIR --last --criterion D --draws 500 --seed 1
--plant euler --ruler-draws 0``: 99.96 (95 % interval over draws 99.90 to 100.01), no violation, every run home; a
constant speed that turns at 150 ms has 98.56. A structured actor reaches more, see :mod:`emb_train.structured`.
The 10 million steps of the preset were not measured.
"""

from __future__ import annotations

from emb_train.presets._own import PHYSICAL, own_hyper_parameters
from emb_train.rewards import LogDeterminant
from emb_train.training.configuration import Configuration

PRESET = Configuration(
    preset="best-four-d",
    summary="all four parameters within 50 %; log-determinant of the physical Fisher information",
    ranges="pm50",
    parameters=("k_m", "k_1", "T_c", "f_v"),
    reward=LogDeterminant(scale=0.05),
    ppo=own_hyper_parameters(10_000_000),
    conditions=PHYSICAL,
)
