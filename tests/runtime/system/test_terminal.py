"""A terminal that is not there is told, and never a traceback."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("closed", "said"), [(">&-", "emb-replay: the result cannot be written"), (">&- 2>&-", ""), ("2>&-", "")]
)
def test_a_command_whose_output_is_closed_ends_with_its_exit_code(closed: str, said: str) -> None:
    code = (
        "from emb_runtime.errors import EmbError\n"
        "from emb_runtime.system.terminal import complain, show\n"
        "import sys\n"
        "try:\n"
        "    show('result')\n"
        "except EmbError as err:\n"
        "    sys.exit(complain('emb-replay', err))\n"
    )
    shell = ["sh", "-c", f'"$0" -c "$1" {closed}', sys.executable, code]
    ran = subprocess.run(shell, capture_output=True, text=True, timeout=60, check=False)
    assert ran.returncode == (0 if closed == "2>&-" else 2)
    assert ran.stderr.startswith(said)
    assert "Traceback" not in ran.stderr
