"""Libraries to preload into a kernel that is an ordinary program.

``xstate_shim.c`` lets an old one run on a processor with AMX, ``slow_shim.c`` lets it live slowly.
"""

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
SLOW_TOLD = "time runs slowly"
"""What ``slow_shim.c`` says on the kernel's console when it begins."""
XSTATE, SLOW = (Path(__file__).with_name(name) for name in ("xstate_shim.c", "slow_shim.c"))


class ShimUse(Enum):
    """When to preload the library for AMX."""

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


def xstate_wanted(use: ShimUse) -> bool:
    """Whether to preload the library for AMX on this computer."""
    return use is ShimUse.ALWAYS or (use is ShimUse.AUTO and host_has_amx(Path("/proc/cpuinfo").read_text()))


def compiled(source: Path) -> Path:
    """Path of the library made from one of the sources. Compiled once per source text, into the cache.

    Raises:
        BusError: there is no C compiler, or it did not compile.
    """
    library = cache_directory() / f"{source.stem}-{hashlib.sha256(source.read_bytes()).hexdigest()[:16]}.so"
    if set(str(library)) & set(" :"):  # the loader takes either for the end of a name
        raise BusError(f"no library can be loaded from {library}: set XDG_CACHE_HOME to one without blanks")
    if library.exists():
        return library
    compiler = shutil.which("cc")
    if compiler is None:
        raise BusError(
            f"the kernel is to run with a library made from {source.name}, which takes a C compiler: "
            f"`sudo apt-get install {' '.join(COMPILER_PACKAGES)}`"
        )
    try:
        library.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BusError(f"no place for the compiled {source.name} ({error}): set XDG_CACHE_HOME") from error
    with tempfile.TemporaryDirectory(dir=library.parent) as directory:
        fresh = Path(directory, library.name)
        result = subprocess.run(
            [compiler, "-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared", "-o", fresh, source],
            capture_output=True,
            text=True,
            check=False,
        )
        if result.returncode != 0:
            raise BusError(f"{source} did not compile: {result.stderr.strip()}")
        fresh.replace(library)  # at once, so that two runs at a time never see half a library
    return library
