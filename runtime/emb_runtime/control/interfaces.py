"""Interfaces of the loop to what is handed in: the actor that decides, and the journal that records."""

from __future__ import annotations

from typing import Protocol

from emb_runtime.log.ring_buffer import Level
from emb_runtime.records import CycleRecord, Frame


class Actor(Protocol):
    """Source of the wanted currents: a policy, or the way home."""

    def begin(self) -> None:
        """Reset the actor's memory: a run begins."""
        ...

    def act(self, angle: float, velocity: float, step: float, applied_current: float) -> float:
        """Current wanted for the period that begins at this sample [A]; the last argument acted in the one before."""
        ...


class Journal(Protocol):
    """Record of a run, in the order of the calls; never waits."""

    def push_frame(self, frame: Frame) -> None:
        """Record a frame that was on the bus."""

    def push_cycle(self, record: CycleRecord) -> None:
        """Record one control cycle."""

    def push_estimate(self, time_ns: int, step: int, estimate: tuple[float, ...]) -> None:
        """Record the estimate at a sample: values, then standard deviations."""

    def push_learnt(self, time_ns: int, step: int, numbers: tuple[float, ...]) -> None:
        """Record what is possible at a sample, see :func:`emb_runtime.learning.known.numbers`."""

    def push_event(self, time_ns: int, code: str, text: str) -> None:
        """Record an event of the safety chain."""

    def push_log(self, time_ns: int, level: Level, text: str) -> None:
        """Record a line for a person."""
