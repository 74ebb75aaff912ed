"""The first file system of a stock kernel: a shell, the kernel modules, and the script that mounts the caller's files.

Source of the archive's layout: the kernel's ``Documentation/driver-api/early-userspace/buffer-format.rst``.
"""

from __future__ import annotations

import lzma
import shlex
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path

import zstandard

from emb_runtime.errors import BusError

_GZIP = 31  # zlib's window bits for a gzip header
_DIRECTORY, _PROGRAM, _FILE = 0o040755, 0o100755, 0o100644
_FOLDERS = ("dev", "host", "memory", "root")

# /host is the caller's root as it is, /root the same with a layer of memory over it that takes what is written.
_SCRIPT = """#!/bin/busybox sh
b=/bin/busybox
$b mount -t devtmpfs dev /dev
while read -r module parameters; do $b insmod "/$module" $parameters || exit 1; done </modules
p9() {{ $b mount -t 9p -o "trans=virtio,version=9p2000.L,msize=1048576,$1" "$2" "/root$3"; }}
$b mount -t 9p -o trans=virtio,version=9p2000.L,msize=1048576,ro,cache=loose host /host || exit 1
$b mount -t tmpfs memory /memory && $b mkdir /memory/upper /memory/work || exit 1
$b mount -t overlay -o lowerdir=/host,upperdir=/memory/upper,workdir=/memory/work overlay /root || exit 1
$b mount -t devtmpfs dev /root/dev || exit 1
p9 cache=mmap work {work} || exit 1
p9 cache=none state {state} || exit 1
exec $b switch_root /root {init}
"""


def unpack(data: bytes) -> bytes:
    """Data that gzip, xz or zstd packed, told by its first bytes; other data as it is. What follows it is ignored."""
    if data.startswith(b"\x1f\x8b"):
        return zlib.decompressobj(_GZIP).decompress(data)
    if data.startswith(b"\xfd7zXZ\0"):
        return lzma.LZMADecompressor().decompress(data)
    if data.startswith(b"\x28\xb5\x2f\xfd"):
        return zstandard.ZstdDecompressor().decompressobj().decompress(data)
    return data


def load_order(tree: Path, wanted: Iterable[str]) -> list[Path]:
    """The files of the ``wanted`` modules and of all that they need, each after those that it needs itself.

    Args:
        tree: the modules of one kernel, with depmod's ``modules.dep``.
        wanted: names as ``modprobe`` takes them, with ``_``. Those that are built into the kernel need no file.

    Raises:
        BusError: the kernel has one of them neither built in nor as a module.
    """
    needs = {}
    for line in (tree / "modules.dep").read_text().splitlines():
        path, _, others = line.partition(":")
        needs[_name(path)] = (path, others.split())
    builtin = {_name(line) for line in (tree / "modules.builtin").read_text().splitlines()}
    order: dict[str, None] = {}
    for name in wanted:
        if name in needs:
            itself, dependencies = needs[name]
            order |= dict.fromkeys([*reversed(dependencies), itself])  # modprobe loads the last of them first
        elif name not in builtin:
            raise BusError(f"the kernel of {tree} has no module {name}: install Debian's linux-image-amd64")
    return [tree / path for path in order]


def _name(path: str) -> str:
    return path.rpartition("/")[2].partition(".")[0].replace("-", "_")


def initramfs(
    shell: Path, modules: Iterable[Path], parameters: Mapping[str, str], work: Path, state: Path, init: Path
) -> bytes:
    """The archive, as the kernel takes it.

    Args:
        shell: a busybox that needs no libraries.
        modules: to be loaded in this order, unpacked here where they are compressed.
        parameters: of modules, by their name.
        work: the directory that stays writable.
        state: where emb-hil keeps what passes between host and guest, writable too.
        init: the first program in the caller's file system.
    """
    files: list[tuple[str, int, bytes]] = [(name, _DIRECTORY, b"") for name in ("bin", *_FOLDERS)]
    lines = []
    for path in modules:
        name = _name(path.name)
        files.append((f"{name}.ko", _FILE, unpack(path.read_bytes())))
        lines.append(f"{name}.ko {parameters.get(name, '')}\n")
    words = {"work": work, "state": state, "init": init}
    script = _SCRIPT.format_map({name: shlex.quote(str(word)) for name, word in words.items()})
    files += [
        ("bin/busybox", _PROGRAM, shell.read_bytes()),
        ("modules", _FILE, "".join(lines).encode()),
        ("init", _PROGRAM, script.encode()),
    ]
    return b"".join(_entry(number, *file) for number, file in enumerate([*files, ("TRAILER!!!", 0, b"")], 1))


def _entry(number: int, name: str, mode: int, data: bytes) -> bytes:
    """One file: a header of hexadecimal words, the name, the data, each padded to four bytes."""
    fields = (number, mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(name.encode()) + 1, 0)
    head = b"070701" + b"".join(b"%08X" % field for field in fields) + name.encode() + b"\0"
    return head + b"\0" * (-len(head) % 4) + data + b"\0" * (-len(data) % 4)
