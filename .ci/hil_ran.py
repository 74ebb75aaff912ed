"""Fails unless the hardware-in-the-loop tests ran: ``hil_ran.py JUNIT_XML``.

A gate that only looks at pytest's exit status is passed by tests that were never collected, or skipped.
"""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ElementTree

PACKAGE = "tests.hil."
MODULES = ("test_emb_hil", "test_chain", "test_qemu")


def complaint(path: str) -> str | None:
    """What is wrong with the report at ``path``, or None."""
    cases = [case for case in ElementTree.parse(path).iter("testcase") if case.get("classname", "").startswith(PACKAGE)]
    ran = {case.get("classname") for case in cases}
    missing = [name for name in MODULES if PACKAGE + name not in ran]
    if missing:
        return f"no test ran of tests/hil: {', '.join(missing)}"
    bad = [
        f"{case.get('name')} ({outcome.tag})"
        for case in cases
        for outcome in case
        if outcome.tag in ("skipped", "failure", "error")
    ]
    return f"hardware-in-the-loop tests that did not pass: {', '.join(bad)}" if bad else None


if __name__ == "__main__":
    sys.exit(complaint(sys.argv[1]))
