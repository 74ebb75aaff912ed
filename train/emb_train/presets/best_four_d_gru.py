"""best-four-d with an actor that remembers: how the brake answered could tell it which brake it has.

It does not help there: trained as long, with ``--steps 1000000`` and seeds 0 and 1, and evaluated by ``emb-train
evaluate DIR --last --criterion D --draws 500 --seed 1 --plant euler --ruler-draws 0``, it has 99.12 and 98.76 (95 %
intervals over draws of at most ±0.12), best-four-d 99.78 and 99.97, all without a violation and every run home. On
best-four-e with ``initial_deviation`` 0.25, so with less exploration, it has 21.52 and the actor without a memory 20.83
(±0.08), with seed 0 alone. It is here to be measured against.
"""

from __future__ import annotations

from dataclasses import replace

from emb_train.presets import best_four_d

PRESET = replace(
    best_four_d.PRESET,
    preset="best-four-d-gru",
    summary="best-four-d with a memory of 32 numbers",
    ppo=replace(best_four_d.PRESET.ppo, memory=32),
)
