"""Fails unless the plays on a real vcan0 ran: ``hil_ran.py JUNIT_XML``.

A gate that only looks at pytest's exit status is passed by tests that were never collected, or skipped.
"""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ElementTree

MODULES = ("test_emb_hil", "test_plays")
PLAYS = ("normal", "interrupted", "loop_killed", "loop_and_recorder_killed", "link_down", "bus_off", "node_killed")


def complaint(path: str) -> str | None:
    """Says what is wrong with the report at ``path``; None if nothing is."""
    cases = [case for case in ElementTree.parse(path).iter("testcase") if "tests.hil." in case.get("classname", "")]
    ran = {case.get("classname", "").rpartition(".")[2] for case in cases}
    ran |= {case.get("name", "").partition("[")[2].rstrip("]") for case in cases}
    if missing := [name for name in (*MODULES, *PLAYS) if name not in ran]:
        return f"no test ran of: {', '.join(missing)}"
    bad = [
        f"{case.get('name')} ({outcome.tag})"
        for case in cases
        for outcome in case
        if outcome.tag in ("skipped", "failure", "error")
    ]
    return f"tests that did not pass: {', '.join(bad)}" if bad else None


if __name__ == "__main__":
    sys.exit(complaint(*sys.argv[1:]))
