"""Fails unless the tests that need a kernel with CAN ran: ``hil_ran.py JUNIT_XML PACKAGE [MODULE ...]``.

A gate that only looks at pytest's exit status is passed by tests that were never collected, or skipped.
"""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ElementTree

MODULES = {
    "tests.hil": ("test_emb_hil", "test_chain", "test_watchdog", "test_qemu"),
    "tests.virtual": ("test_commissioning", "test_faults", "test_mapped_drives", "test_udp_multicast"),
}


def complaint(path: str, package: str, *modules: str) -> str | None:
    """Says what is wrong with the report at ``path`` on a package of tests, or on some of its modules; else None."""
    cases = [c for c in ElementTree.parse(path).iter("testcase") if c.get("classname", "").startswith(f"{package}.")]
    ran = {case.get("classname") for case in cases}
    missing = [name for name in modules or MODULES[package] if f"{package}.{name}" not in ran]
    if missing:
        return f"no test ran of {package}: {', '.join(missing)}"
    bad = [
        f"{case.get('name')} ({outcome.tag})"
        for case in cases
        for outcome in case
        if outcome.tag in ("skipped", "failure", "error")
    ]
    return f"tests of {package} that did not pass: {', '.join(bad)}" if bad else None


if __name__ == "__main__":
    sys.exit(complaint(*sys.argv[1:]))
