"""The process of ``emb-run --live``: shows the logs of one run as they grow, and ends when its standard input does.

``python -m emb_bench.live.process DOCUMENT_FD``, started by ``emb-run``, which finds it by the entry point
``emb_runtime.viewers`` and waits for one line of JSON: ``ready`` or ``error``.
"""

from __future__ import annotations

import select
import sys
from pathlib import Path

from emb_bench.live.follow import NewLogs, follow
from emb_bench.live.serve import Server
from emb_runtime.errors import LogError, UsageError
from emb_runtime.system import child_process
from emb_runtime.system.realtime import step_back
from emb_runtime.system.terminal import mention

POLL = 0.02  # Time between two looks at a log [s]


def main(arguments: list[str]) -> int:
    """Show one run. Returns the exit status."""
    step_back()
    (fd,) = map(int, arguments)
    document = child_process.read_document(fd)
    try:
        server = Server(port=document["port"], empty="the run has not begun yet")
    except UsageError as err:
        child_process.write_answer({"error": str(err)})
        return 1
    logs = NewLogs(Path(document["folder"]), document["pattern"])
    child_process.write_answer({"ready": [server.page, server.addresses]})
    follow(logs, server, _wait, _complain)
    server.close()
    return 0


def _wait() -> bool:
    return not select.select([0], [], [], POLL)[0]  # nothing is ever written to it: it is readable once it is closed


def _complain(err: LogError) -> None:
    mention(f"live: {err}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
