"""f_v in the thesis's range, home after 500 ms, for longer than single-viscous.

Measured with ``--steps 4000000``, seed 0, by the table that follows the training: 2.750e7 on the grid of 40 values, no
violation, every run home, beside 2.600e7 for a constant +6 A and 2.752e7 for the best blind switch into the same
shield. The 10 million steps of the preset were not measured.
"""

from __future__ import annotations

from emb_train.presets._own import own_hyper_parameters
from emb_train.rewards import InformationIncrement
from emb_train.training.configuration import Configuration

PRESET = Configuration(
    preset="best-viscous",
    summary="viscous friction unknown in the thesis's range; weighted Fisher information by the true value, 10 M steps",
    ranges="viscous",
    parameters=("f_v",),
    reward=InformationIncrement(scale=3e-7),
    ppo=own_hyper_parameters(10_000_000),
)
