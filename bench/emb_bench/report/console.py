"""Text of a result on a terminal, where verdicts stand out in colour; plain everywhere else."""

from __future__ import annotations

import sys

from emb_runtime.system import terminal

BAD = r"(?P<bad>^WARNING:.*|NOT [a-z]+|DOES NOT [A-Z]+|LIMITS LEFT|FAILED|\bNO\b|AT THE BORDER)"
CARE = r"(?P<care>^NOTE:|if the model were right|identified, but biased)"
GOOD = r"(?P<good>; identified\b(?! if|, but)|limits held|\bfits:)"


def show(text: str) -> None:
    """Prints a result.

    Raises:
        UsageError: standard output takes nothing: it is closed, or the disk behind it is full.
    """
    terminal.show(coloured(text) if sys.stdout is not None and sys.stdout.isatty() else text)


def coloured(text: str) -> str:
    """The text with the colours of a terminal; ``NO_COLOR`` in the environment leaves it plain."""
    from rich.console import Console
    from rich.highlighter import RegexHighlighter
    from rich.theme import Theme

    class Verdicts(RegexHighlighter):
        highlights = [f"(?m){BAD}", f"(?m){CARE}", f"(?m){GOOD}"]  # noqa: RUF012  # rich reads it from the class

    console = Console(force_terminal=True, theme=Theme({"bad": "bold red", "care": "yellow", "good": "green"}))
    with console.capture() as captured:
        console.print(Verdicts()(text), soft_wrap=True, end="")
    return captured.get()
