"""The commands' first step: a Ctrl-C is no traceback, neither in the imports nor when nobody has taken it.

Only commands import it: from then on a Ctrl-C just ends the process, for nothing is open yet.
"""

from __future__ import annotations

import _thread
import gc
import importlib
import io
import os
import signal
import sys
from collections.abc import Callable
from types import FrameType, TracebackType

from emb_runtime.errors import EXIT_DONE, EXIT_INTERRUPTED, UsageError

TAKEN = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # Else somebody wants a Ctrl-C ignored
if TAKEN:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def run_command(
    module: str,
    message: str,
    interrupted: int = EXIT_INTERRUPTED,
    prepare: Callable[[], object] | None = None,
    takes_signals: bool = False,
) -> int:
    """Run the ``main`` of a module; a Ctrl-C in its imports just ends the process: nothing is open yet.

    Args:
        module: imported here.
        message: printed for a Ctrl-C in ``main`` that nobody has taken, unless the exception has one.
        interrupted: exit code for it.
        prepare: called before the import.
        takes_signals: ``main`` does; until then a Ctrl-C ends the process as in the imports.
    """
    pressed: list[int] = []

    def interrupt(number: int, _frame: FrameType | None) -> None:
        pressed.append(number)
        raise KeyboardInterrupt

    _prepare_streams()
    sys.excepthook, sys.unraisablehook = _show, _raise_again
    try:
        if prepare is not None:
            prepare()
        gc.disable()  # imports leave no garbage to search for
        main: Callable[[], int] = importlib.import_module(module).main
        gc.freeze()
        gc.enable()
        if TAKEN and not takes_signals:
            signal.signal(signal.SIGINT, interrupt)
        return main()
    except BrokenPipeError:  # ``--help | head``: argparse of Python 3.11.2 lets it through
        return EXIT_DONE
    except KeyboardInterrupt as err:
        message = str(err) or message
    except Exception as err:
        if not pressed:  # else a library that was interrupted made another error of it
            if not isinstance(err, OSError) or err.filename is None:
                raise
            from emb_runtime.system.terminal import complain

            return complain(sys.argv[0].rpartition("/")[2], UsageError(f"{err.filename}: {err.strerror}"))
    finally:
        if signal.getsignal(signal.SIGINT) is interrupt:
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # nothing is open any more
        _flush()
        gc.freeze()  # or Python searches all that was imported for garbage before it ends: a fifth of a short command
    if message:
        from emb_runtime.system.terminal import mention  # nothing is imported before the handler is set

        mention(message)
    return interrupted


def _show(kind: type[BaseException], err: BaseException, trace: TracebackType | None) -> None:
    """Show an error that nobody has taken; a Ctrl-C is none."""
    if not issubclass(kind, KeyboardInterrupt):
        sys.__excepthook__(kind, err, trace)


def _raise_again(lost: sys.UnraisableHookArgs) -> None:
    """Raise a Ctrl-C again that came where Python drops errors, in a destructor or a callback of a library."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        from threading import Timer

        Timer(0.01, _thread.interrupt_main).start()  # once this function has returned: what it raises is dropped, too
    else:
        sys.__unraisablehook__(lost)


def _prepare_streams() -> None:
    """Every standard stream is open, and output takes any text."""
    for descriptor in (0, 1, 2):  # a closed one would be given to the next file, and lost to a child's
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # none, or somebody else's
            stream.reconfigure(errors="backslashreplace")  # a sign for each that its encoding lacks


def _flush() -> None:
    """Empty the buffers of output; one that nobody reads any more is no error."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # closed before the program began
            try:
                stream.flush()
            except OSError:
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())  # Python flushes once more at exit


def emb_gateway() -> int:
    """A drive with another protocol as a node of emb-run; until it opens anything, Ctrl-C just ends it."""
    return run_command("emb_runtime.cli.gateway", "", takes_signals=True)


def emb_run() -> int:
    """One guarded experiment on a brake, logged; until it opens anything, Ctrl-C just ends it."""
    try:
        return run_command("emb_runtime.cli.main", "", prepare=_choose_core, takes_signals=True)
    except UsageError as err:
        from emb_runtime.system.terminal import complain

        return complain("emb-run", err)


def _choose_core() -> None:
    from emb_runtime.system import compiled_core  # an import, too

    compiled_core.choose()
