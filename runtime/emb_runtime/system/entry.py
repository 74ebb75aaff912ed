"""The commands' first step: a Ctrl-C is no traceback, while the imports take their time or when nobody has taken it."""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import io
import os
import signal
import sys
from collections.abc import Callable, Sequence

from emb_runtime.errors import EXIT_INTERRUPTED, EXIT_SAFETY_STOP, UsageError


def start(
    module: str,
    message: str,
    interrupted: int = EXIT_INTERRUPTED,
    taken: Sequence[int] = (),
    prepare: Callable[[], object] | None = None,
) -> int:
    """Run the ``main`` of a module.

    Args:
        module: where it is; imported here.
        message: what to say of a Ctrl-C that nobody has taken, unless the exception says it.
        interrupted: exit code for it.
        taken: signals that the ``main`` takes in its first step. They end the program like a Ctrl-C until then.
        prepare: called before the import.

    Returns:
        The exit code.
    """
    _prepare_streams()

    def leave(_number: int, _frame: object) -> None:  # at once: nothing is open yet, and the imports may take seconds
        with contextlib.suppress(OSError):
            os.write(2, f"{message}\n".encode() if message else b"")
        os._exit(interrupted)

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, *taken)}
    try:
        for number, handler in before.items():
            if handler in (signal.default_int_handler, signal.SIG_DFL):  # an exception may leave an import as another
                signal.signal(number, leave)
        back = [number for number in before if number not in taken]
        try:
            if prepare is not None:
                prepare()
            loaded = importlib.import_module(module)
        except BaseException:
            back = list(before)
            raise
        finally:
            for number in back:
                signal.signal(number, before[number])
        return int(loaded.main())
    except KeyboardInterrupt as err:
        message = str(err) or message
    finally:
        _flush()
        gc.freeze()  # or Python searches all that was imported for garbage before it ends: a fifth of a short command
    if message:
        from emb_runtime.system.terminal import (
            mention,  # whatever is imported before the handler is set can be interrupted
        )

        mention(message)
    return interrupted


def _prepare_streams() -> None:
    """Every standard stream is open, and output takes any text."""
    for descriptor in (0, 1, 2):  # a closed one would be given to the next file, and lost to a child's own
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a result must not fail for a sign that the encoding lacks


def _flush() -> None:
    """Empty the buffers of output; one that nobody reads any more is no error."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # closed before the program began
            try:
                stream.flush()
            except OSError:
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())  # Python flushes once more at exit


def emb_run() -> int:
    """``emb-run``: before anything is opened, an interruption is the same stop as later."""
    message = "emb-run: stopped by the operator while it started; nothing was opened"
    taken = (signal.SIGINT, signal.SIGTERM)
    for number in taken:  # when all is done, Python puts the default actions back before it ends
        atexit.register(signal.signal, number, signal.SIG_IGN)
    try:
        return start("emb_runtime.cli.main", message, EXIT_SAFETY_STOP, taken, choose_core)
    except UsageError as err:
        from emb_runtime.system.terminal import complain

        return complain("emb-run", err)


def choose_core() -> None:
    """Take the compiled core, where there is one that does what its sources do."""
    from emb_runtime.system import compiled_core  # after the handlers are set, as all that takes its time

    compiled_core.choose(lambda: str(importlib.import_module("emb_runtime.cli.core_check").difference()))
