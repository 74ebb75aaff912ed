"""``emb-hil``: run a command where ``vcan0`` exists, on the host if it can, else in a kernel of our own."""

from __future__ import annotations

import argparse
import fcntl
import os
import shlex
import signal
import socket
import struct
import sys
from collections.abc import Sequence

from emb_bench.hil import uml
from emb_bench.hil.guest import INTERFACE, not_started
from emb_bench.hil.uml import KernelCommand, state_directory, supervise
from emb_runtime.errors import EXIT_BUS, EXIT_USAGE, BusError, EmbError, UsageError
from emb_runtime.system.terminal import Parser, complain, mention

_USAGE = "emb-hil [--host | --uml] [--root] [--slow N] [--boot S] [--memory MB]\n               -- COMMAND..."
_EPILOG = f"""\
If vcan0 exists and is up, the command runs on this kernel. Otherwise it runs in a User-Mode Linux kernel, with your
files, working directory, environment and user; /proc, /sys, /dev, /run and /dev/shm are those of that kernel. Standard
input is empty. Ctrl-C and SIGTERM reach the command; a second one kills it.

example:
  emb-hil --slow 100 -- sh -c 'emb-node --iface vcan0 & emb-run --iface vcan0'

exit status: that of the command (128 + n if signal n ended it, 126 or 127 if it could not be started);
{EXIT_BUS} no vcan0 or the kernel died, {EXIT_USAGE} wrong usage."""

_MAKE = f"`sudo ip link add dev {INTERFACE} type vcan && sudo ip link set {INTERFACE} up`"

_SIOCGIFFLAGS, _IFF_UP = 0x8913, 1

SLOWEST = 1000
"""Largest ``--slow``. Far beyond it, a program that waits for a time without sleeping would seem to hang."""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = Parser(
        prog="emb-hil",
        usage=_USAGE,
        description="Run a command where the CAN interface vcan0 exists.",
        epilog=_EPILOG,
    )
    where = p.add_mutually_exclusive_group()
    where.add_argument("--host", action="store_true", help="use this kernel or fail")
    where.add_argument("--uml", action="store_true", help="always use a User-Mode Linux kernel")
    p.add_argument("--root", action="store_true", help="the command is root in the kernel (not on the host)")
    p.add_argument("--slow", type=int, default=1, metavar="N",
                        help="--uml with a clock N times slower, so that delays of this computer count N times "
                        "less; idle time is skipped (default 1: real time)")  # fmt: skip
    p.add_argument("--boot", type=float, default=60.0, metavar="S",
                        help="longest wait for the kernel to come up [s] (default 60)")  # fmt: skip
    p.add_argument("--memory", type=int, default=2048, metavar="MB", help="memory of the kernel (default 2048)")
    return p


def _run(options: argparse.Namespace, command: list[str]) -> int:
    if not options.uml and _is_up(INTERFACE):
        return _become(command)
    if options.host:
        raise BusError(f"{INTERFACE} does not exist here, or is down: {_MAKE}")
    with uml.own_processor(), state_directory() as state:

        def start() -> KernelCommand:
            return KernelCommand(command, state, options.memory, options.slow, options.root, options.boot)

        return supervise(start)


def _is_up(name: str) -> bool:
    """Returns True if an interface of this process's network namespace exists and is up: netdevice(7)."""
    if all(name != other for _, other in socket.if_nameindex()):
        return False
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        answer = fcntl.ioctl(sock, _SIOCGIFFLAGS, struct.pack("=16sH22x", name.encode(), 0))
    return bool(struct.unpack_from("=H", answer, 16)[0] & _IFF_UP)


def _become(command: list[str]) -> int:
    """Run a command on this kernel in place of this process; its exit status where it cannot be started."""
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    try:
        os.execvp(command[0], command)
    except OSError as error:
        message, status = not_started(command[0], error)
        mention(message.removesuffix("\n"))
        return status


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    for descriptor in (0, 1, 2):  # a closed one would be given to the next file that is opened
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    given = list(sys.argv[1:] if arguments is None else arguments)
    mark = given.index("--") if "--" in given else len(given)
    p = parser()
    command = given[mark + 1 :]
    try:
        if not command and (words := p.parse_known_args(given[:mark])[1]) and not words[0].startswith("-"):
            raise UsageError(f"{words[0]}: write the command after --, as in `emb-hil -- {shlex.join(words)}`")
        options = p.parse_args(given[:mark])
        if options.memory < 128:
            raise UsageError("--memory must be at least 128 MB")
        if not 1 <= options.slow <= SLOWEST:
            raise UsageError(f"--slow: expected 1 to {SLOWEST}, got {options.slow}")
        if not 1 <= options.boot <= 3600:
            raise UsageError(f"--boot: expected 1 to 3600 s, got {options.boot:g}")
        if options.slow > 1 and options.host:
            raise UsageError("--slow is for User-Mode Linux: expected no --host with it")
        options.uml |= options.slow > 1
        if not command:
            raise UsageError("no command: write it after --, as in `emb-hil -- ip link show vcan0`")
        return _run(options, command)
    except EmbError as error:
        return complain("emb-hil", error)
    except BrokenPipeError:  # who read our output is gone, as with `| head`
        return 128 + signal.SIGPIPE
    except OSError as error:
        return complain("emb-hil", BusError(str(error)))


if __name__ == "__main__":
    sys.exit(main())
