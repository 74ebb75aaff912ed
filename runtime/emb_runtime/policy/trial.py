"""Policy files from outside: each is tried by a confined process first, whose verdict decides whether it is loaded.

ONNX Runtime is a large library in C++ that a file can make work for long, take memory, or crash, and its calls cannot
be interrupted. All of that happens to a process that may take little of either and ends with this one.
"""

from __future__ import annotations

import base64
import os
import pickle
import signal
from pathlib import Path

from emb_runtime.config.bench import Bench
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.policy.policy import Policy, load_policy, read_policy
from emb_runtime.system.child_process import HAS_CHILD_PROCESSES, Child

PROGRAM = "emb_runtime.policy.trial_process"
MEMORY = 256 << 20  # Memory that a file may take to be loaded and asked [bytes]

MULTIPLE = 10.0
"""Processor time for that, as a multiple of what this computer takes to start the process and import ONNX Runtime: 0.3
to 1 s. Ours take about half of that, on a slow computer as on a fast one."""

TIMEOUT = 300.0
"""Longest wait for the process to start, and for its verdict on a computer that has other things to do [s]."""


def admit_policy(source: str | Path | bytes, bench: Bench, evaluated_by: str = "") -> Policy:
    """A policy that nobody vouches for, tried and then loaded.

    Where there are no processes of our own there is no brake either, only a simulated one: it is loaded untried.

    Args:
        source: path of the ONNX file, or its bytes.
        bench: what it is to drive.
        evaluated_by: see :func:`emb_runtime.policy.policy.load_policy`.

    Raises:
        UsageError: the file cannot be read, or no process can be started to try it.
        PolicyRefusedError: see :func:`emb_runtime.policy.policy.load_policy`; or trying it took too much time or
            memory, or ended the process.
    """
    data = source if isinstance(source, bytes) else read_policy(Path(source))
    if not HAS_CHILD_PROCESSES:
        return load_policy(data, bench, evaluated_by)
    return load_policy(data, bench, _try(data, bench, evaluated_by), compared=True)


def _try(data: bytes, bench: Bench, evaluated_by: str) -> str:
    """Name of what evaluates a policy, by the process that tried it."""
    document = {
        "policy": base64.b64encode(data).decode(),
        "bench": base64.b64encode(pickle.dumps(bench)).decode(),
        "evaluated_by": evaluated_by,
        "parent": os.getpid(),
        "memory": MEMORY,
        "multiple": MULTIPLE,
    }
    try:
        child = Child("trial", PROGRAM, document, [])
    except OSError as err:
        raise UsageError(f"cannot start the process that tries the policy: {err.strerror}") from err
    try:
        answer = child.answer(TIMEOUT)
        if "ready" not in answer:
            raise UsageError(f"cannot try the policy: {answer.get('error', 'no answer')}")
        seconds = answer["ready"]
        answer = child.answer(TIMEOUT)
        exit_code = child.exit_code
    finally:
        child.kill()
    if isinstance(accepted := answer.get("accepted"), str):
        return accepted
    if exit_code == -signal.SIGKILL:
        reason = f"loading and asking it takes more than {seconds:.1f} s of processor time: not an actor of ours"
    else:
        reason = str(answer.get("refused") or f"it could not be tried: {answer.get('error')}")
    raise PolicyRefusedError(reason)
