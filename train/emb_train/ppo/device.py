"""Where networks learn. Experiments always run on the CPU."""

from __future__ import annotations

from typing import TYPE_CHECKING

from emb_runtime.errors import UsageError

if TYPE_CHECKING:
    import torch

    from emb_train.ppo.ppo import PpoConfig

DEVICES = ("auto", "cpu", "cuda")
WIDE = 512
"""Units of a hidden layer from which a GPU is worth its launches and copies; a rule of thumb."""


def chosen_device(name: str, ppo: PpoConfig) -> torch.device:
    """The device that is meant by one of :data:`DEVICES`, for networks of this shape.

    ``auto`` is the CPU, which is deterministic, unless there is a GPU and the networks are wide.

    Raises:
        UsageError: it is cuda, and torch has none.
    """
    import torch

    there = torch.cuda.is_available()
    if name == "cuda" and not there:
        raise UsageError("--device cuda: torch finds no CUDA device; use --device cpu, or a torch built for CUDA")
    worth = there and max(ppo.hidden, default=0) >= WIDE
    return torch.device("cuda" if name == "cuda" or (name == "auto" and worth) else "cpu")
