"""``emb-replay live``: runs shown while they go on."""

from __future__ import annotations

import glob
import shlex
import time
from dataclasses import dataclass
from pathlib import Path

from emb_bench.live.follow import NewLogs, follow
from emb_bench.live.process import POLL
from emb_bench.live.serve import HOST, PORT, Server
from emb_bench.options import Options, option
from emb_runtime.errors import LogError, UsageError
from emb_runtime.system.terminal import mention


@dataclass(frozen=True, eq=False)
class LiveOptions(Options):
    """Options of the server."""

    host: str = option(HOST, "address to listen at (default: 127.0.0.1, this computer only)", "HOST")
    port: int = option(PORT, "port to listen at; 0 for a free one (default: 8765)", "N", kind=int)


def live(place: Path, options: LiveOptions) -> None:
    """Show runs in progress: on a page in the browser, or in Foxglove.

    Show the newest log of a folder, and each log that is written there later: on a page in the browser, which also
    lists all logs, and in Foxglove and Lichtblick over the Foxglove WebSocket protocol (open the address as a
    connection, with the layout of the documentation). The command only reads files and does not affect a run. Ctrl-C
    ends it. emb-run --live shows one run.

    Args:
        place: folder whose logs are shown, or one log; its parent folder must exist.
        options: address and port.

    Raises:
        UsageError: an argument is wrong, or the address cannot be listened at.
        LogError: the one log is too damaged.
    """
    if not 0 <= options.port <= 65535:
        raise UsageError(f"--port: expected 0 to 65535, got {options.port}")
    if not place.parent.is_dir():
        raise UsageError(f"{place}: there is no folder {place.parent}: make it, or name a place in another")
    one = bool(place.suffix) and not place.is_dir()
    command = f"emb-run --iface sim --log {shlex.quote(str(place) if one else f'{place}/')}"
    server = Server(
        options.host, options.port, f"no log {'is' if one else 'in'} {place} yet: in another terminal, {command}"
    )
    logs = NewLogs(place.parent, glob.escape(place.name), old=True) if one else NewLogs(place)
    for newest in logs.names[:1]:
        logs.choose(newest)

    def wait() -> bool:
        time.sleep(POLL)
        return True

    def complain(err: LogError) -> None:
        if one:
            raise err
        mention(str(err))

    try:
        mention(f"shows {'the log' if one else 'the logs in'} {place}: {server.addresses}; Ctrl-C ends it")
        follow(logs, server, wait, complain)
    except KeyboardInterrupt:
        pass
    finally:
        server.close()
