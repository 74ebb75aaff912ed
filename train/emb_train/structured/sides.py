"""What :mod:`emb_train.structured.stiction` says of one brake, for N side by side and without a branch, in torch.

All are columns, shape [N, 1], float64. The constants are tensors: see :mod:`emb_train.structured.actor`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from emb_train.structured.stiction import CUBIC, DOUBT, FARTHEST, KINK, KINK_DECAY, PEAK, REST, STEEPNESS

_CONSTANTS = {
    "third": 1.0 / 3.0,
    "sixth": 1.0 / 6.0,
    "twelfth": 1.0 / 12.0,
    "steepness": STEEPNESS,
    "bent": STEEPNESS * CUBIC,
    "peak": PEAK,
    "kink": KINK,
    "decay": -KINK_DECAY,
    "rest": REST,
    "doubt": DOUBT,
    "farthest": FARTHEST,
}


class Ways(NamedTuple):
    """:class:`emb_train.structured.stiction.Passage`, with the derivatives of angle and velocity side by side."""

    angle: Tensor
    velocity: Tensor
    by_velocity: tuple[Tensor, Tensor]
    by_pull: tuple[Tensor, Tensor]
    by_friction: tuple[Tensor, Tensor]
    stopped: Tensor
    kinked: Tensor


class Sides(nn.Module):
    """:func:`emb_train.structured.stiction.passage` and :func:`emb_train.structured.stiction.contact`."""

    third: Tensor
    sixth: Tensor
    twelfth: Tensor
    steepness: Tensor
    bent: Tensor
    peak: Tensor
    kink: Tensor
    decay: Tensor
    rest: Tensor
    doubt: Tensor
    farthest: Tensor

    def __init__(self) -> None:
        """Keep the constants."""
        super().__init__()
        for name, value in _CONSTANTS.items():
            self.register_buffer(name, torch.tensor(value, dtype=torch.float64))

    def forward(
        self,
        now: tuple[Tensor, Tensor, Tensor, Tensor],
        x: Tensor,
        v: Tensor,
        t: Tensor,
        spread: Tensor,
        spread_against: Tensor,
        spread_along: Tensor,
    ) -> Ways:
        """One period; arguments as those of the scalar function."""
        pull, coulomb, damping, spring = now
        toward = torch.where(pull >= 0.0, 1.0, -1.0).double()
        strength = torch.abs(pull)
        braked, driven = strength + coulomb, strength - coulomb
        r = torch.relu(driven) / braked
        forward = torch.where(v == 0.0, toward, torch.sign(v))
        touching = torch.where(x > 0.0, spring, 0.0)
        a = pull - forward * coulomb - damping * v
        b = -(damping * a + touching * v)
        e = -(damping * b + touching * a)
        x1 = x + t * (v + t * (0.5 * a + t * (self.sixth * b + t * (0.25 * self.sixth) * e)))
        v1 = v + t * (a + t * (0.5 * b + t * self.sixth * e))
        v1 = v1 - torch.where(x * x1 < 0.0, spring * t * x1 * x1 / (2.0 * torch.abs(x1 - x)), 0.0)
        stops = forward * v1 < 0.0
        before = torch.where(stops, t * v / (v - v1), t)
        after = torch.where(driven > 0.0, t - before, 0.0)
        v1 = torch.where(stops, v1 * r, v1)
        x1 = torch.where(stops, x + 0.5 * (v * before + v1 * after), x1)
        ahead = toward * v
        wide = self.doubt * spread_along
        started, kept = (ahead + self.rest) / spread, (ahead + t * driven) / wide
        sooner = started < kept
        width = torch.where(sooner, spread, wide)
        kinks = torch.cat([(ahead + t * braked) / spread_against, torch.minimum(started, kept)], 1)
        kinks = torch.minimum(torch.maximum(kinks, -self.farthest), self.farthest)
        widths = torch.cat([spread_against, width], 1)
        squares = kinks * kinks
        bend = torch.tanh(kinks * (self.steepness + self.bent * squares))
        excess = widths * (self.peak * torch.exp(-0.5 * squares) - torch.abs(kinks) * (0.5 - 0.5 * torch.abs(bend)))
        bends = (widths * widths * torch.exp(self.decay * squares)).sum(1, keepdim=True)
        first, second = bend[:, :1], bend[:, 1:]
        against, along = 0.5 - 0.5 * first, 0.5 + 0.5 * second
        moving = against + along
        stopped = torch.relu(1.0 - moving)
        told = torch.where(sooner, 1.0, torch.relu(second)).double()
        untold = (1.0 - told * told) * along * along * torch.relu(width * width - spread * spread)
        slower = 1.0 - r
        full, half = t * (1.0 - 0.5 * t * damping), t * t * (0.5 - self.sixth * t * damping)
        kept_up = told * along
        sliding, leaning, reversing = against + kept_up, toward * (against - kept_up), r * before
        turned = r * after
        way, rest = before * (0.5 * before + turned), 0.5 * after * after
        return Ways(
            x1,
            v1 + toward * slower * (excess[:, 1:] - excess[:, :1]),
            (moving * t + stopped * (before + turned), moving + stopped * r),
            (sliding * half + stopped * (way + rest), sliding * full + stopped * (reversing + after)),
            (
                leaning * half - stopped * (forward * way + toward * rest),
                leaning * full - stopped * (forward * reversing + toward * after),
            ),
            stopped,
            slower * slower * self.kink * bends + untold,
        )

    def contact(self, x: Tensor, x1: Tensor, t: Tensor, v: Tensor, v1: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See the scalar function."""
        crossed = x * x1 < 0.0
        inside = torch.where(torch.minimum(x, x1) < 0.0, 0.0, 1.0).double()
        share = torch.where(crossed, (torch.relu(x1) - torch.relu(x)) / (x1 - x), inside)
        made = x1 > 0.0
        farther = 0.5 * share * torch.maximum(x, x1)
        slow, fast = 2.0 * v + v1, 3.0 * v + v1
        to_velocity = torch.where(crossed, farther, inside * (x + t * self.sixth * slow))
        crossing = torch.where(made, share * share * x1 * self.third, share * x * (1.0 - share * self.third))
        return share, to_velocity, torch.where(crossed, crossing, inside * (x + t * self.twelfth * fast))
