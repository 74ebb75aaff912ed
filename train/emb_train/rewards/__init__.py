"""Step rewards: small named functions of what a step did to the brake and to its Fisher information.

The thesis's read the weighted FIM (outputs divided by 100 rad and 500 rad/s, eq. 4.21); every one of them is packed as
an upper triangle, for a batch of N brakes with n parameters.
"""

from __future__ import annotations

from collections.abc import Mapping

from emb_train.rewards.adaptive import AdaptiveReturn
from emb_train.rewards.determinant import DeterminantGain
from emb_train.rewards.increment import EigenvalueIncrement, InformationIncrement, PenalisedIncrement
from emb_train.rewards.logarithms import LogDeterminant, LogSmallest, LogTrace
from emb_train.rewards.trajectory import HybridReturn, TrajectoryReturn
from emb_train.rewards.transition import Mark, Returning, Reward, Transition

REWARDS: Mapping[str, type] = {
    kind.__name__: kind
    for kind in (
        InformationIncrement,
        EigenvalueIncrement,
        PenalisedIncrement,
        AdaptiveReturn,
        TrajectoryReturn,
        HybridReturn,
        DeterminantGain,
        LogDeterminant,
        LogSmallest,
        LogTrace,
    )
}
"""By the name that a configuration gives them."""

__all__ = [
    "REWARDS",
    "AdaptiveReturn",
    "DeterminantGain",
    "EigenvalueIncrement",
    "HybridReturn",
    "InformationIncrement",
    "LogDeterminant",
    "LogSmallest",
    "LogTrace",
    "Mark",
    "PenalisedIncrement",
    "Returning",
    "Reward",
    "TrajectoryReturn",
    "Transition",
]
