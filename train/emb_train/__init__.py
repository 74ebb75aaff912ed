"""Learning an excitation: environments, rewards, asymmetric PPO."""

from __future__ import annotations

CHECKPOINT = "checkpoint.safetensors"
"""File name of a training's last checkpoint; here so that it is known without importing torch."""
