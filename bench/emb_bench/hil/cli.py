"""``emb-hil``: run a command where ``vcan0`` exists, on the host if it can, else in a kernel of our own."""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from emb_bench.hil import host, qemu, uml
from emb_bench.hil.kernel import Kernel, KernelCommand, state_directory
from emb_bench.hil.supervise import EXIT_TIMEOUT, supervise
from emb_runtime.errors import EXIT_BUS, EXIT_DONE, EXIT_USAGE, BusError, EmbError, UsageError
from emb_runtime.system.terminal import complain

_USAGE = """emb-hil [--setup] [--host | --uml | --qemu] [--root] [--slow N] [--timeout S]
               [--memory MB] [--shim USE] -- COMMAND..."""
_EPILOG = f"""\
The command sees your files, working directory, environment and user; /proc, /sys, /dev, /run and /dev/shm are the
kernel's own, standard input is empty. Ctrl-C and SIGTERM reach the command, a second one kills. With --qemu only
what is written below the working directory lasts, and time is virtual.

exit status: the command's own (128 + n where signal n ended it, 126 or 127 where it could not be started);
{EXIT_TIMEOUT} time limit reached, {EXIT_BUS} vcan0 cannot be had or the kernel died, {EXIT_USAGE} wrong usage."""

SLOWEST = 1000
"""Largest ``--slow``. Far beyond it, a program that waits for a time without sleeping would seem to hang."""
_UBUNTU = (
    f"Ubuntu has no {uml.PACKAGE}, but kernels with vcan: `sudo apt-get install linux-modules-extra-$(uname -r)`, "
    "`sudo ip link add dev vcan0 type vcan`, `sudo ip link set vcan0 up`"
)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="emb-hil",
        usage=_USAGE,
        description="Run a command where the CAN interface vcan0 exists.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--setup",
        action="store_true",
        help="install what a vcan0 needs with apt-get (as root); with --uml or --qemu what that needs",
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--host", action="store_true", help="on this kernel or not at all")
    where.add_argument("--uml", action="store_true", help="in a User-Mode Linux kernel, whatever this one can")
    where.add_argument("--qemu", action="store_true", help="in QEMU: virtual time, and CAN controllers can0 and can1")
    parser.add_argument("--root", action="store_true", help="the command is root in the kernel (not on the host)")
    parser.add_argument("--slow", type=int, default=1, metavar="N",
                        help="--uml, N times slower than this computer, which then disturbs it N times less; "
                        "idle time is skipped (default 1: real time)")  # fmt: skip
    parser.add_argument("--timeout", type=float, metavar="S", help="end the command after S seconds, start-up included")
    parser.add_argument("--memory", type=int, default=2048, metavar="MB", help="memory of the kernel (default 2048)")
    parser.add_argument("--shim", choices=[use.value for use in uml.ShimUse], default=uml.ShimUse.AUTO.value,
                        help="library for processors with AMX (default: where needed)")  # fmt: skip
    return parser


def _missing_for_vcan(uml_asked: bool) -> list[str]:
    missing = [] if shutil.which("cc") else list(uml.COMPILER_PACKAGES)
    if uml_asked:
        return missing if shutil.which(uml.PROGRAM) else [*missing, uml.PACKAGE]
    try:
        with host.interface():
            pass
    except BusError:
        if shutil.which(uml.PROGRAM) is None:
            missing.append(uml.PACKAGE)
    return missing


def _setup(missing: Sequence[str]) -> None:
    """Installs what is missing; only on explicit request."""
    if not missing:
        return
    if os.geteuid() != 0:
        raise UsageError(f"--setup needs root: `sudo apt-get install {' '.join(missing)}` does the same. {_UBUNTU}")
    for step in (["update"], ["install", "--yes", "--no-install-recommends", *missing]):
        try:
            subprocess.run(["apt-get", *step], check=True, stdin=subprocess.DEVNULL)
        except FileNotFoundError as error:
            raise UsageError(f"--setup knows only apt-get, which is not here: install {' '.join(missing)}") from error
        except subprocess.CalledProcessError as error:
            raise BusError(f"`apt-get {' '.join(step)}` ended with status {error.returncode}. {_UBUNTU}") from error


def _run(options: argparse.Namespace, command: list[str]) -> int:
    with contextlib.ExitStack() as stack:
        if not (options.uml or options.qemu):
            try:
                stack.enter_context(host.interface())
            except BusError:
                if options.host:
                    raise
            else:
                return supervise(lambda: host.HostCommand(command), options.timeout)
        if not options.qemu:
            stack.enter_context(uml.own_processor())
        state = stack.enter_context(state_directory())
        return supervise(lambda: KernelCommand(command, _kernel(options, state), state, options.root), options.timeout)


def _kernel(options: argparse.Namespace, state: Path) -> Kernel:
    if options.qemu:
        return qemu.kernel(options.memory, state)
    return uml.kernel(options.memory, uml.ShimUse(options.shim), options.slow, state)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    for descriptor in (0, 1, 2):  # a closed one would be given to the next file that is opened
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    given = list(sys.argv[1:] if arguments is None else arguments)
    mark = given.index("--") if "--" in given else len(given)
    parser = _parser()
    options = parser.parse_args(given[:mark])
    command = given[mark + 1 :]
    try:
        if not (options.timeout is None or options.timeout > 0) or options.memory < 128:
            raise UsageError("--timeout must be above 0 s and --memory at least 128 MB")
        if not 1 <= options.slow <= SLOWEST:
            raise UsageError(f"--slow: expected 1 to {SLOWEST}, got {options.slow}")
        if options.slow > 1 and (options.qemu or options.host):
            raise UsageError("--slow is for User-Mode Linux: time is virtual with --qemu, and not ours with --host")
        options.uml |= options.slow > 1
        if options.setup:
            _setup(qemu.missing_packages() if options.qemu else _missing_for_vcan(options.uml))
        elif not command:
            raise UsageError("no command: write it after --, as in `emb-hil -- ip link show vcan0`")
        return _run(options, command) if command else EXIT_DONE
    except EmbError as error:
        return complain("emb-hil", error)
    except BrokenPipeError:  # who read our output is gone, as with `| head`
        return 128 + signal.SIGPIPE
    except OSError as error:
        return complain("emb-hil", BusError(str(error)))


if __name__ == "__main__":
    sys.exit(main())
