"""The preloaded library that lets an old kernel run on a processor with AMX; see ``xstate_shim.c``."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from enum import Enum
from pathlib import Path

from emb_runtime.errors import BusError

COMPILER_PACKAGES = ["gcc", "libc6-dev"]
SOURCE = Path(__file__).with_name("xstate_shim.c")


class ShimUse(Enum):
    """When to preload the library."""

    AUTO = "auto"
    ALWAYS = "always"
    NEVER = "never"


def host_has_amx(cpuinfo: str) -> bool:
    """Whether the text of /proc/cpuinfo names a processor with AMX tiles."""
    return "amx_tile" in cpuinfo.split()


def cache_directory() -> Path:
    """The user's cache directory of this tool."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "emb-excite"


def shim_library(use: ShimUse) -> Path | None:
    """Path of the compiled library where it is wanted, else None. Compiled once per source text, into the cache.

    Raises:
        BusError: it is needed and there is no C compiler, or it did not compile.
    """
    if use is ShimUse.NEVER or (use is ShimUse.AUTO and not host_has_amx(Path("/proc/cpuinfo").read_text())):
        return None
    library = cache_directory() / f"xstate-{hashlib.sha256(SOURCE.read_bytes()).hexdigest()[:16]}.so"
    if library.exists():
        return library
    compiler = shutil.which("cc")
    if compiler is None:
        raise BusError(
            "the library that the kernel needs on processors with AMX needs a C compiler: "
            f"`sudo apt-get install {' '.join(COMPILER_PACKAGES)}`"
        )
    try:
        library.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BusError(f"no place for the compiled {SOURCE.name} ({error}): set XDG_CACHE_HOME") from error
    with tempfile.TemporaryDirectory(dir=library.parent) as directory:
        fresh = Path(directory, library.name)
        result = subprocess.run(
            [compiler, "-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared", "-o", fresh, SOURCE],
            capture_output=True,
            text=True,
            check=False,
        )
        if result.returncode != 0:
            raise BusError(f"{SOURCE} did not compile: {result.stderr.strip()}")
        fresh.replace(library)  # at once, so that two runs at a time never see half a library
    return library
