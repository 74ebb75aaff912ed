"""``--live``: a process of its own that shows a run while it goes on. It reads the growing log, and nothing else."""

from __future__ import annotations

import glob
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata

from emb_runtime.cli.options import Plan, names_a_file
from emb_runtime.errors import UsageError
from emb_runtime.system.child_process import HAS_CHILD_PROCESSES, Child
from emb_runtime.system.terminal import mention

ENTRY_POINTS = "emb_runtime.viewers"  # Entry-point group of the module that shows a run, under the name ``live``
START_TIMEOUT = 10.0  # Longest wait for the process to be ready [s]


@contextmanager
def shown(plan: Plan) -> Iterator[None]:
    """While this lasts, the logs of a plan are shown, where that is asked for.

    Raises:
        UsageError: there is nothing that could show them, or it does not start.
    """
    if plan.live is None:
        yield
        return
    if not HAS_CHILD_PROCESSES:
        raise UsageError("--live: needs Linux; emb-replay live shows a run from another terminal")
    entries = list(metadata.entry_points(group=ENTRY_POINTS, name="live"))
    if not entries:
        raise UsageError("--live: nothing is installed that shows a run; emb_bench does")
    one = names_a_file(plan.log)
    document = {
        "folder": str(plan.log.parent if one else plan.log),
        "pattern": f"{glob.escape(plan.log.stem)}*{glob.escape(plan.log.suffix)}" if one else "*.mcap",
        "port": None if plan.live == "lines" else int(plan.live),
    }
    try:
        child = Child("live", entries[0].value, document, [])
    except OSError as err:
        raise UsageError(f"--live: cannot start its process: {err.strerror}") from err
    try:
        answer = child.answer(START_TIMEOUT)
        if "ready" not in answer:
            raise UsageError(f"--live: {answer.get('error', 'its process gave no answer')}")
        if answer["ready"]:
            mention(f"live at {answer['ready']}")
        yield
    finally:
        child.end()
