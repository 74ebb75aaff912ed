"""The actors that are shipped, made anew of the references in them: ``python -m tools.shipped_actors``."""

from __future__ import annotations

import sys

from emb_bench.config.bench import load_bench
from emb_export.file import reference_file
from emb_runtime.policy.policy import shipped_actor_path
from emb_runtime.system.terminal import show

REFERENCES = {False: "four-d-exact-quadratic", True: "four-time-exact-quadratic"}
"""Name of the reference in the actor for a whole experiment, and of the one for ``emb-run --quick``."""


def main() -> int:
    """Write both files."""
    bench = load_bench()
    for quick, name in REFERENCES.items():
        data, path = reference_file(name, bench), shipped_actor_path(quick)
        path.write_bytes(data)
        show(f"{path.name}: {name}, {len(data)} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
