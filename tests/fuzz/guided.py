"""One target under atheris, which looks for bytes that reach code not reached before. Needs ``pip install atheris``.

    python tests/fuzz/guided.py decoder -runs=100000 -seed=1

What follows the target's name is for libFuzzer: ``-help=1`` lists it. Ends with 0 if nothing was found; what was found
is printed with its traceback, and the bytes are left in a file that, given as the last argument, plays them again.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

atheris: Any = import_module("atheris")  # not everywhere, and without types where it is
with atheris.instrument_imports(
    include=[
        "emb_runtime.can.codec",
        "emb_runtime.can.e2e",
        "emb_runtime.can.receiver",
        "emb_runtime.can.messages",
        "emb_runtime.safety.guard",
        "emb_runtime.can.receiver",
        "emb_runtime.safety.state_machine",
    ]
):
    from tests.fuzz.draws import ByteDraw
    from tests.fuzz.targets import TARGETS


def main() -> None:
    """Fuzz the named target; libFuzzer ends the process."""
    if len(sys.argv) < 2 or sys.argv[1] not in TARGETS:
        sys.exit(f"expected one of {', '.join(TARGETS)}, got {' '.join(sys.argv[1:2]) or 'nothing'}")
    target = TARGETS[sys.argv.pop(1)]
    atheris.Setup(sys.argv, lambda data: target(ByteDraw(data)))
    atheris.Fuzz()


if __name__ == "__main__":
    main()
