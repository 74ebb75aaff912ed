"""The one tree of errors. A message states what was expected, what came, and what to do; a class carries its exit code.

A command line catches :class:`EmbError`, prints the message as one line, and exits with ``exit_code``;
nothing that a user can cause ends in a traceback.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager

EXIT_DONE = 0
EXIT_CHECK_FAILED = 1  # Exit code of a check that ran without error and was not passed
EXIT_USAGE = 2
EXIT_SAFETY_STOP = 3
EXIT_BUS = 4
EXIT_POLICY_REFUSED = 5
EXIT_LOG = 6  # Exit code of a log that cannot be read, or was not written to its end
EXIT_CANNOT_TELL = 7  # Exit code of a check that neither passes nor fails
EXIT_UNEXPLAINED = 8  # Exit code of a run whose measurements no one brake explains
EXIT_OUTSIDE = 9  # Exit code with --strict of a brake outside of the ranges for which the limits are guaranteed
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as a shell has it


def near(got: str, names: Iterable[str], shown: Mapping[str, str] = {}) -> str:
    """A name that may have been meant, for the end of a message; empty if none is near what was given.

    Case and the dashes of an option count for nothing: any two options would be alike by them. A name is
    ``shown`` as it is there.
    """
    from difflib import get_close_matches

    bare = {name.lstrip("-").casefold(): name for name in names}
    found = get_close_matches(got.lstrip("-").casefold(), bare, n=1)
    return f"; did you mean {shown.get(name := bare[found[0]], name)}?" if found else ""


class EmbError(Exception):
    """Root of everything that a command reports to its user in one line."""

    exit_code = EXIT_USAGE


class UsageError(EmbError):
    """The command was given a request that it cannot meet: wrong argument, missing file, missing extra."""


class UnknownNameError(UsageError, KeyError):
    """A name that is none of a record's; also a KeyError, as of any mapping."""

    __str__ = Exception.__str__  # a KeyError shows its message in quotes


@contextmanager
def needs(purpose: str, extra: str) -> Iterator[None]:
    """Imports for a purpose; a library that is missing is a UsageError with the command that installs its extra."""
    try:
        yield
    except ImportError as err:
        library = (err.name or str(err)).partition(".")[0]
        raise UsageError(
            f"{purpose} needs {library}: in the clone, pip install -c constraints.txt -e '.[{extra}]'; "
            f"from a folder of wheels, pip install --find-links dist 'emb-excite[{extra}]'"
        ) from err


class BenchFileError(UsageError):
    """``bench.toml`` is missing, malformed, incomplete or contradictory."""


class SafetyStopError(EmbError):
    """The run was stopped to protect the bench."""

    exit_code = EXIT_SAFETY_STOP


class BusError(EmbError):
    """The CAN interface could not be opened, or was lost."""

    exit_code = EXIT_BUS


class PolicyRefusedError(EmbError):
    """The policy file is damaged, or its contract does not match the bench it should drive."""

    exit_code = EXIT_POLICY_REFUSED


class LogError(EmbError):
    """A log is not a log of ours, or too damaged for a true result."""

    exit_code = EXIT_LOG


class CheckFailedError(EmbError):
    """A check that comes before a result was not passed: nothing is written."""

    exit_code = EXIT_CHECK_FAILED


class FrameError(EmbError, ValueError):
    """A value does not fit its CAN signal, or a frame does not fit its message."""
