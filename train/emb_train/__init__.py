"""Learning an excitation: environments, rewards, asymmetric PPO, contextual evolution of references, evaluation."""

from __future__ import annotations


def emb_train() -> int:
    """``emb-train``; imports the command after the first handler of a Ctrl-C."""
    from emb_runtime.system.entry import start  # this package is also a library

    return start("emb_train.cli", "emb-train: interrupted")
