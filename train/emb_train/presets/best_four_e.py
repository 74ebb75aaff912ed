"""All four parameters within 50 % of nominal, E-optimal: the physical information from a uniform prior on.

Measured with ``--steps 2000000``, seed 0, by ``emb-train evaluate DIR --last --criterion E --draws 500 --seed 1
--plant euler --ruler-draws 0``: 20.58 (95 % interval over draws 20.54 to 20.62), no violation, every run home; a
ramp has 20.56. A structured actor reaches more, see :mod:`emb_train.structured`.
The 10 million steps of the preset were not measured.

What is learned is for the actor that explores, and the mean action need not follow: in a training of 1,000,000 steps
with seed 0, the return with exploration rises from 3.10 to 3.30, that of the mean action from 3.10 to 3.78 in the fifth
of eight iterations, and then falls to 3.62. So the iteration that did best has 21.48 on the 500 draws, the last 20.66.
"""

from __future__ import annotations

from emb_train.presets._own import PHYSICAL, own_hyper_parameters
from emb_train.rewards import LogSmallest
from emb_train.training.configuration import Configuration

PRESET = Configuration(
    preset="best-four-e",
    summary="all four parameters within 50 %; smallest eigenvalue of the physical Fisher information",
    ranges="pm50",
    parameters=("k_m", "k_1", "T_c", "f_v"),
    reward=LogSmallest(scale=0.2),
    ppo=own_hyper_parameters(10_000_000),
    conditions=PHYSICAL,
)
