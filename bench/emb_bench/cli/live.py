"""``emb-replay live``: runs shown while they go on."""

from __future__ import annotations

import argparse
import glob
import time
from pathlib import Path

from emb_bench.live.follow import NewLogs, follow
from emb_bench.live.process import POLL
from emb_bench.live.serve import HOST, PORT, Server
from emb_runtime.errors import EXIT_DONE, LogError, UsageError
from emb_runtime.system.terminal import mention

HELP = "show runs while they go on, on a page in the browser"
DESCRIPTION = """\
Show the logs that appear in a folder on a page in the browser, while they are written. The command only reads files and
does not affect a run. Ctrl-C ends it. emb-run --live shows one run.
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    p.add_argument(
        "place", type=Path, nargs="?", default=Path("runs"), metavar="DIR|LOG",
        help="folder whose new logs are shown, or one log; its parent folder must exist (default: runs/)",
    )  # fmt: skip
    p.add_argument("--host", default=HOST, help="address to listen at (default: %(default)s, this computer only)")
    p.add_argument("--port", type=int, default=PORT, help="port to listen at; 0 for a free one (default: %(default)s)")


def run(args: argparse.Namespace) -> int:
    """Show runs until Ctrl-C; gives the exit code."""
    if not 0 <= args.port <= 65535:
        raise UsageError(f"--port: expected 0 to 65535, got {args.port}")
    if not args.place.parent.is_dir():
        raise UsageError(f"{args.place}: there is no folder {args.place.parent}: make it, or name a place in another")
    server = Server(args.host, args.port)
    one = bool(args.place.suffix) and not args.place.is_dir()
    logs = NewLogs(args.place.parent, glob.escape(args.place.name), old=True) if one else NewLogs(args.place)

    def wait() -> bool:
        time.sleep(POLL)
        return True

    def complain(err: LogError) -> None:
        if one:
            raise err
        mention(str(err))

    try:
        mention(f"shows {'the log' if one else 'new logs in'} {args.place}: {server.address}; Ctrl-C ends it")
        follow(logs, server, wait, complain, once=one)
    except KeyboardInterrupt:
        pass
    finally:
        server.close()
    return EXIT_DONE
