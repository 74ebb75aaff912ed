"""Policy files from outside: each is tried by a confined process first, whose verdict decides whether it is loaded.

ONNX Runtime is a large library in C++ that a file can make work for long, take memory, or crash, and its calls cannot
be interrupted. All of that happens to a process that may take little of either and ends with this one.
"""

from __future__ import annotations

import base64
import os
import pickle
import signal
import sys
import time
from pathlib import Path

from emb_runtime.config.bench import Bench
from emb_runtime.errors import EmbError, PolicyRefusedError, UsageError
from emb_runtime.policy.policy import Policy, load_policy, read_policy
from emb_runtime.system import child_process
from emb_runtime.system.child_process import HAS_CHILD_PROCESSES, Child, confine, end_with

PROGRAM = "emb_runtime.policy.trial"
MEMORY = 256 << 20  # Memory that a file may take to be loaded and evaluated [bytes]

MULTIPLE = 10.0
"""Processor time for that, as a multiple of what this computer takes to start the process and import ONNX Runtime: 0.3
to 1 s. Ours take about half of that, on a slow computer as on a fast one."""

LEAST = 5.0
"""Least processor time for that [s]: a kernel that counts in ticks, as one in a virtual machine, may give the process
those of others later, and none for what it has done."""

TIMEOUT = 300.0
"""Longest wait for the process to start, and for its verdict on a computer that has other things to do [s]."""


def admit_policy(source: str | Path | bytes, bench: Bench) -> Policy:
    """A policy of unknown origin, by its path or its bytes, tried and then loaded.

    Without child processes there is no brake either, only a simulated one: it is loaded untried.

    Raises:
        UsageError: the file cannot be read, or no process can be started to try it.
        PolicyRefusedError: see :func:`emb_runtime.policy.policy.load_policy`; or trying it took too much time or
            memory, or ended the process.
    """
    data = source if isinstance(source, bytes) else read_policy(Path(source))
    if HAS_CHILD_PROCESSES:
        _try(data, bench)
    return load_policy(data, bench)


def _try(data: bytes, bench: Bench) -> None:
    document = {
        "policy": base64.b64encode(data).decode(),
        "bench": base64.b64encode(pickle.dumps(bench)).decode(),
        "parent": os.getpid(),
        "memory": MEMORY,
        "multiple": MULTIPLE,
        "least": LEAST,
    }
    try:
        child = Child("trial", PROGRAM, document, TIMEOUT)
    except OSError as err:
        raise UsageError(f"cannot try the policy: {err}") from err
    try:
        answer = child.read_answer(TIMEOUT)
        exit_code = child.exit_code
    finally:
        child.kill()
    if "accepted" in answer:
        return
    if exit_code == -signal.SIGKILL:
        reason = f"loading and running it takes more than {child.ready:.1f} s of processor time: not a policy of ours"
    else:
        reason = str(answer.get("refused") or f"it could not be tried: {answer.get('error')}")
    raise PolicyRefusedError(reason)


def main(arguments: list[str]) -> int:
    """The process that tries one policy; gives its exit status.

    ``python -m emb_runtime.policy.trial DOCUMENT_FD``, started by :func:`admit_policy` and by nobody else. It answers
    on standard output, one JSON object per line: ``ready`` with the processor time that the file may take [s], then
    ``accepted``, or ``refused`` with the reason.
    """
    document = child_process.read_document(int(arguments[0]))
    end_with(document["parent"])
    import onnxruntime  # noqa: F401  # so that it is part of the time that is measured

    bench = pickle.loads(base64.b64decode(document["bench"]))  # from the parent, which made it
    data = base64.b64decode(document["policy"])
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)  # what a library has to say when it fails is not for the user
    seconds = max(document["least"], document["multiple"] * time.process_time())
    confine(document["memory"], seconds)
    child_process.write_answer({"ready": seconds})
    try:
        load_policy(data, bench)
    except EmbError as err:
        child_process.write_answer({"refused": str(err)})
    except MemoryError:
        child_process.write_answer({"refused": f"loading it takes more than {document['memory'] >> 20} MiB of memory"})
    else:
        child_process.write_answer({"accepted": True})
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
