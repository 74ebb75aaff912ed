"""Networks as excitations; apart from the others, for torch takes a second to import."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import nn

from emb_runtime.errors import UsageError
from emb_train.envs.excitations import Currents, Seen, Stateless

PLAIN = 3  # Columns of the observation of an actor that does not see the applied current


class Network(Stateless):
    """A network without state: raw observations [N, 3] to currents [A], [N, 1]; no exploration."""

    def __init__(self, module: nn.Module) -> None:
        """Use this module, :class:`emb_train.ppo.DeployedActor` for one."""
        self._module = module

    def __call__(self, seen: Seen) -> Currents:
        """See :class:`Excitation`."""
        with torch.no_grad():
            currents = self._module(torch.from_numpy(np.ascontiguousarray(seen[:, :PLAIN])))
        return _column(currents.numpy())


def _column(currents: Any) -> Currents:
    if currents.ndim != 2 or currents.shape[1] != 1:
        raise UsageError(f"expected an actor that gives one current for each experiment, got shape {currents.shape}")
    return np.array(currents[:, 0], np.float64)
