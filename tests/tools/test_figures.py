"""The page of figures takes the rows that a command prints, and keeps everything else."""

from __future__ import annotations

from tools.figures import replaced

PAGE = """\
| claim | limit | value | command | commit |
|---|---|---|---|---|
| old | 1 | 2 | `python a.py` | aaa |
| other | 1 | 2 | `python b.py` | aaa |
| old, too | 1 | 2 | `python a.py` | aaa |
Text.
"""


def test_the_rows_of_a_command_are_those_that_it_prints() -> None:
    page = replaced(PAGE, "python a.py", ["| new | – | 3 |"], "bbb")
    assert page == PAGE.replace(
        "| old | 1 | 2 | `python a.py` | aaa |", "| new | – | 3 | `python a.py` | bbb |"
    ).replace("| old, too | 1 | 2 | `python a.py` | aaa |\n", "")
