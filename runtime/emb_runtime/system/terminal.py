"""The operator's end of a command: results on standard output, errors in one line on standard error, the wish to end.

Whatever a text is made of, names and strings of files included, it can do nothing to the terminal: characters that
control one are written as escape sequences, visibly.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import math
import os
import re
import select
import shlex
import shutil
import signal
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from typing import Any, NoReturn

from emb_runtime.errors import EmbError, UsageError, near

LONGEST_MESSAGE = 1000  # Characters of an error's message
LONGEST_STRING = 2000  # Characters of a string from outside
ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals with which an operator ends a command, those of them that this operating system has."""

DOCUMENT_SCHEMA = 1
"""Form of every JSON document that a command prints or writes; it rises when a key goes, or means something else."""
HELP_WIDTH = 80  # Columns of a help, at most

_NOT_ASCII = re.compile("[^ -~]")

_FOLDERS = re.compile(r"(^|[=@:,])(?:/|[A-Za-z]:[\\/])(?:[^\\/]*[\\/])*(?=[^\\/])")


def escaped(text: str, allowed: str = "") -> str:
    """A text in which all characters but printable ones and those ``allowed`` are escape sequences.

    So none controls a terminal, changes the direction of the text, or cannot be seen.
    """
    if text.isprintable():
        return text
    return _NOT_ASCII.sub(lambda c: c[0] if c[0].isprintable() or c[0] in allowed else ascii(c[0])[1:-1], text)


def without_folders(text: str) -> str:
    """A typed argument in which each absolute path is its last name: for a file that others will read."""
    return _FOLDERS.sub(r"\1", text)


def typed_command(name: str, arguments: Sequence[str]) -> str:
    """The command line as it was typed, without private folders."""
    return shlex.join([name, *map(without_folders, arguments)])


def one_line(text: str, most: int = LONGEST_STRING) -> str:
    """A string from outside for a text of ours: one line, of a bounded length."""
    return escaped(text[:most]) + (f" … ({len(text)} characters)" if len(text) > most else "")


def show(text: str, dressed: Callable[[str], str] = str) -> None:
    """Print a result, dressed with colours; a reader that has had enough (``| head``) is no error.

    Of the characters that control a terminal only newlines in the text reach it. UsageError if standard output takes
    nothing: it is closed, or the disk behind it is full.
    """
    if sys.stdout is None:  # closed before the program began
        raise UsageError("the result cannot be written to standard output: it is closed")
    try:
        sys.stdout.write(dressed(escaped(text, "\n")) + "\n")
        sys.stdout.flush()
    except OSError as err:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nothing may be written to it at exit either
        if not isinstance(err, BrokenPipeError):
            raise UsageError(f"the result cannot be written to standard output: {err.strerror}") from err


def mention(text: str) -> None:
    """Write progress to standard error; ignore errors of writing."""
    if sys.stderr is not None:  # closed before the program began
        with contextlib.suppress(OSError):
            sys.stderr.write(escaped(text, "\n") + "\n")
            sys.stderr.flush()


class StopRequest:
    """Set by Ctrl-C, SIGTERM and SIGHUP from now on, read by the loop."""

    def __init__(self) -> None:
        self._requested = False
        for number in ENDING:
            if signal.getsignal(number) is not signal.SIG_IGN:  # nohup had that one ignored
                signal.signal(number, self._request)

    def __call__(self) -> bool:
        """Returns True if the operator has ended the command."""
        return self._requested

    def _request(self, _signal: int, _frame: object) -> None:
        self._requested = True


def is_interactive() -> bool:
    """Returns True if standard input is a terminal, so that somebody can answer."""
    return sys.stdin is not None and sys.stdin.isatty()


def forget_typed() -> None:
    """Drop what was typed and nobody has read yet, where standard input is a terminal."""
    if sys.platform != "win32" and is_interactive():
        import termios  # not on Windows

        termios.tcflush(sys.stdin, termios.TCIFLUSH)


def typed_line() -> str | None:
    """The line that was typed on standard input, None if there is none yet; on Windows it is waited for."""
    if sys.platform != "win32" and not select.select([sys.stdin], [], [], 0.0)[0]:
        return None
    return sys.stdin.readline()


def agreed_to_arm(stop_requested: Callable[[], bool], wait: Callable[[], object]) -> bool:
    """Ask on the terminal whether to arm; True if the operator answers y, False for any other answer or an end.

    An answer to an earlier question, or to none, does not count. As long as there is no answer, ``wait`` is called.
    """
    forget_typed()
    mention("Arm now? y and Enter does, anything else ends here.")
    while not stop_requested():
        if (line := typed_line()) is not None:
            return line.strip().lower() in ("y", "yes")
        wait()
    return False


NUMBERS: Mapping[Any, str] = {int: "a whole number", float: "a number, with a point for decimals"}
"""Types of an option that takes a number, and what to write."""


def filled(text: str, width: int) -> str:
    """A text of at most this width: paragraphs are filled, an indented line goes on below its last column."""
    lines: list[str] = []
    for indented, part in itertools.groupby(text.split("\n"), lambda line: line[:1] in ("", " ")):
        for row in part if indented else [" ".join(part)]:
            *_, column = re.finditer(r"^ *|\S {2,}", row)
            below = " " * column.end()
            lines += textwrap.wrap(
                row, width, subsequent_indent=below, break_long_words=False, break_on_hyphens=False
            ) or [""]
    return "\n".join(lines)


class _Help(argparse.RawDescriptionHelpFormatter):
    """A help that fits into a terminal, and is no wider in a wide one."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=min(shutil.get_terminal_size().columns, HELP_WIDTH) - 2)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return filled(text, width)


class Parser(argparse.ArgumentParser):
    """A command line whose wrong use is one line, with the option or the command that may have been meant."""

    def __init__(self, **options: Any) -> None:
        """A parser that takes no option by the beginning of its name, and tells the version."""
        super().__init__(allow_abbrev=False, formatter_class=_Help, **options)
        version = f"{self.prog.partition(' ')[0]} {metadata.version('emb-excite')}"
        self.add_argument("--version", action="version", version=version)

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """The arguments; ends the program with 2 where they are wrong, with 0 after a ``--help``."""
        given, found = sys.argv[1:] if args is None else list(args), namespace
        options = [one for one in itertools.takewhile("--".__ne__, given) if one.startswith("--")]
        unknown = [one for one in options if one.partition("=")[0] not in self._known()]
        if not unknown:  # a misspelt option comes before what is missing because of it
            found, unknown = self.parse_known_args(given, namespace)
            found.typed = given
        if unknown:
            kind = "option" if unknown[0].startswith("-") else "argument"
            name = unknown[0].partition("=")[0]  # it may be an option of another sub-command
            self.error(f"unexpected {kind} {unknown[0]}{near(name, [one for one in self._known() if one != name])}")
        return found

    def error(self, message: str) -> NoReturn:
        """Print what is wrong in one line, and end the program."""
        self.exit(UsageError.exit_code, f"{self.prog}: {escaped(message)} (see {self.prog} --help)\n")

    def _get_value(self, action: argparse.Action, arg_string: str) -> Any:
        try:
            value = super()._get_value(action, arg_string)
            names = () if isinstance(action, argparse._SubParsersAction) else action.choices or ()
            return {str(name).casefold(): name for name in names}.get(str(value).casefold(), value)  # as --criterion d
        except argparse.ArgumentError:
            if action.type not in NUMBERS:
                raise
            raise argparse.ArgumentError(action, f"expected {NUMBERS[action.type]}, got '{arg_string}'") from None

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            names = [str(choice) for choice in action.choices]
            expected = f"expected one of {', '.join(names)}, got {value!r}{near(str(value), names)}"
            raise argparse.ArgumentError(action, expected)

    def _known(self) -> list[str]:
        """Options, those of sub-commands included."""
        below = [action.choices for action in self._actions if isinstance(action.choices, dict)]
        parts = [part for choices in below for part in choices.values() if isinstance(part, Parser)]
        return [*self._option_string_actions, *(name for part in parts for name in part._known())]


def complain(command: str, err: EmbError) -> int:
    """Print in one line what went wrong; returns the exit code for it."""
    line = one_line(" ".join(str(err).split()), LONGEST_MESSAGE)
    mention(f"{command}: {line}")
    return err.exit_code


def json_document(document: Mapping[str, Any]) -> str:
    """A result as one line of JSON, which begins with the number of its form."""
    return as_json({"schema": DOCUMENT_SCHEMA, **document})


def as_json(document: Any) -> str:
    """A value as one line of JSON; a number that is not finite is null, for JSON has no such numbers."""
    return json.dumps(_finite(document), allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
