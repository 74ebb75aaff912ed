"""``python -m emb_runtime``, and of the other packages: which commands there are."""

from __future__ import annotations

import sys
from importlib import metadata

from emb_runtime.system.terminal import Parser


def main(package: str) -> int:
    """Show the version, and every command in a line, by the docstring of its entry point; returns the exit code."""
    scripts = metadata.distribution("emb-excite").entry_points.select(group="console_scripts")
    lines = [f"  {one.name:<14}  {(one.load().__doc__ or '').partition(';')[0].rstrip('.')}" for one in scripts]
    p = Parser(
        prog=package,
        usage=f"python -m {package}",
        description=f"emb-excite {metadata.version('emb-excite')} has these commands, each with --help and --version:",
        epilog="\n".join(lines),
    )
    p.parse_args()
    p.print_help()
    return 0


if __name__ == "__main__":
    sys.exit(main("emb_runtime"))
