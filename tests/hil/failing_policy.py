"""A policy that does not come back: it is hung in a call, or another thread keeps Python's lock."""

from __future__ import annotations

import ctypes
import os
import sys
import threading

from emb_runtime.estimator.estimator import Estimator
from emb_runtime.policy.policy import Policy

FIRST = 100  # Beyond the steps of the test vectors that the policy is tried on before the run
CALLS = 100


def hog() -> None:
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # it takes the lock, not the processor from all others
    sys.setswitchinterval(1e6)
    while True:
        pass


def hang(how: str) -> None:
    if how == "robbed of the lock":
        threading.Thread(target=hog, daemon=True).start()
    else:
        while True:  # the signal that ends a wait for frames may come late, and ends a sleep(3) as well
            ctypes.CDLL(None).sleep(1000)


def make_it_hang(how: str) -> None:
    act, calls = Policy.act, 0

    def failing(self: Policy, angle: float, velocity: float, step: float, estimator: Estimator) -> float:
        nonlocal calls
        calls += step >= FIRST
        if calls > CALLS:
            hang(how)
        return act(self, angle, velocity, step, estimator)

    Policy.act = failing  # type: ignore[method-assign]
