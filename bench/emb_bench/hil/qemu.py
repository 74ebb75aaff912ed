"""A stock Debian kernel in QEMU with the instruction counter: virtual time, emulated CAN controllers, no KVM, no image.

One instruction is one nanosecond, and idle time is skipped, so that the host's load changes nothing that can be seen
inside. Source: QEMU's ``docs/devel/tcg-icount.rst`` and ``docs/system/devices/can.rst``; of the first file system's
layout, the kernel's ``Documentation/driver-api/early-userspace/buffer-format.rst``.
"""

from __future__ import annotations

import lzma
import os
import platform
import re
import shlex
import shutil
import socket
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path

import zstandard

from emb_bench.hil.guest import INTERFACE, SECOND_INTERFACE, VCAN_PARAMETERS
from emb_bench.hil.kernel import Kernel, init_program
from emb_runtime.errors import BusError

PROGRAM, _SHELL = "qemu-system-x86_64", "busybox"
PROGRAM_PACKAGE, SHELL_PACKAGE, KERNEL_PACKAGE = "qemu-system-x86", "busybox-static", "linux-image-amd64"
BITRATE = 1_000_000
#: Its interfaces: two virtual buses, and one bus with two controllers.
_DEVICES = ((INTERFACE, 0), (SECOND_INTERFACE, 0), ("can0", BITRATE), ("can1", BITRATE))
_MODULES = (
    "virtio_pci", "9pnet_virtio", "9p", "overlay",
    "can", "can_raw", "can_bcm", "can_gw", "vcan", "vxcan", "kvaser_pci", "sch_netem",
)  # fmt: skip
_PARAMETERS = {"vcan": VCAN_PARAMETERS}
#: Below the root, what is the kernel's own and hides the caller's.
_OWN = ("dev", "proc", "run", "sys")
_COMMAND_LINE = (
    "console=ttyS0 quiet panic=-1 mitigations=off tsc=reliable nowatchdog preempt=full transparent_hugepage=never"
)
_PROMPT, _MONITOR_S = b"(qemu)", 10.0
_INTERPRETER = 3  # program header of an ELF file that names its dynamic loader
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


def find_kernel(root: Path = Path("/")) -> tuple[Path, Path] | None:
    """The newest kernel image that may be read and has its modules: image and module tree."""
    found = []
    for image in root.glob("boot/vmlinuz-*"):
        tree = root / "lib/modules" / image.name.removeprefix("vmlinuz-")
        if os.access(image, os.R_OK) and (tree / "modules.dep").exists():
            version = [int(number) for number in re.findall(r"\d+", image.name)]
            found.append((version, image, tree))
    return max(found)[1:] if found else None


def find_shell() -> Path | None:
    """A busybox that needs no libraries."""
    found = shutil.which(_SHELL)
    return Path(found) if found and not _is_dynamic(Path(found).read_bytes()) else None


def _is_dynamic(program: bytes) -> bool:
    """Returns True if a 64-bit ELF program needs a loader; layout: elf(5)."""
    start = int.from_bytes(program[32:40], "little")
    size, count = int.from_bytes(program[54:56], "little"), int.from_bytes(program[56:58], "little")
    kinds = (program[start + size * k : start + size * k + 4] for k in range(count))
    return any(int.from_bytes(kind, "little") == _INTERPRETER for kind in kinds)


def vmlinux(image: bytes) -> bytes:
    """The kernel proper out of a boot image: QEMU starts it directly, the emulated processor need not unpack it.

    Source: the kernel's ``Documentation/x86/boot.rst``, fields setup_sects, payload_offset and payload_length.

    Raises:
        BusError: this is no boot image, or packed in a way that is not known here.
    """
    start = (image[0x1F1] + 1) * 512 + int.from_bytes(image[0x248:0x24C], "little")
    program = unpack(image[start : start + int.from_bytes(image[0x24C:0x250], "little")])
    if not program.startswith(b"\x7fELF"):
        raise BusError(f"the kernel image has no ELF program packed by gzip, xz or zstd: install {KERNEL_PACKAGE}")
    return program


def missing_packages() -> list[str]:
    """Debian's packages of what is not here."""
    there = {
        PROGRAM_PACKAGE: shutil.which(PROGRAM),
        SHELL_PACKAGE: find_shell(),
        KERNEL_PACKAGE: find_kernel(),
    }
    return [package for package, what in there.items() if what is None]


def kernel(memory_mb: int, state: Path) -> Kernel:
    """The kernel with what it needs on this host; the working directory becomes its only writable one.

    Raises:
        BusError: something that it needs is missing; says what to install.
    """
    program, shell, found = shutil.which(PROGRAM), find_shell(), find_kernel()
    if program is None or shell is None or found is None:
        raise BusError(
            f"QEMU, a Debian kernel with its modules or a static busybox is missing: "
            f"`sudo apt-get install {' '.join(missing_packages())}`, or as root `emb-hil --setup --qemu`"
        )
    if platform.machine() != "x86_64":
        raise BusError(f"--qemu runs this machine's programs on an x86-64 kernel, and this is {platform.machine()}")
    image, tree = found
    work = Path.cwd()
    if work == Path("/") or work.parts[1] in _OWN:
        raise BusError(f"--qemu brings the working directory inside, which cannot be {work}: change to another")
    program_file, archive = state / "vmlinux", state / "initramfs"
    program_file.write_bytes(vmlinux(image.read_bytes()))
    archive.write_bytes(initramfs(shell, load_order(tree, _MODULES), _PARAMETERS, work, state, init_program(state)))
    monitor = str(state / "monitor")

    def press_ctrl_alt_del() -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
            sock.settimeout(_MONITOR_S)
            sock.connect(monitor)
            sock.sendall(b"sendkey ctrl-alt-delete\n")
            said = b""
            while said.count(_PROMPT) < 2:  # the second one follows the command: to hang up before would lose it
                said += sock.recv(4096) or 2 * _PROMPT

    return Kernel(
        name="QEMU",
        arguments=[
            program, "-accel", "tcg,thread=single", "-icount", "shift=0,sleep=off", "-cpu", "max", "-smp", "1",
            "-m", str(memory_mb), "-nodefaults", "-display", "none", "-no-reboot",
            "-rtc", "base=utc,clock=vm",
            "-chardev", f"file,id=console,path={state}/console,append=on", "-serial", "chardev:console",
            "-monitor", f"unix:{monitor},server=on,wait=off",
            "-kernel", str(program_file), "-initrd", str(archive), "-append", _COMMAND_LINE,
            *_share("host", Path("/"), "on"), *_share("work", work, "off"), *_share("state", state, "off"),
            "-object", "can-bus,id=bus", "-device", "kvaser_pci,canbus=bus", "-device", "kvaser_pci,canbus=bus",
        ],
        environment={"PATH": os.defpath, "HOME": str(state), "TMPDIR": str(state)},
        modules=(),
        devices=_DEVICES,
        throttles=False,
        boot_limit=300.0,
        grace=120.0,
        urgent=False,
        marks={},
        says="",
        knock=press_ctrl_alt_del,
    )  # fmt: skip


def _share(tag: str, directory: Path, readonly: str) -> list[str]:
    path = str(directory).replace(",", ",,")  # QEMU's way to quote one
    return ["-fsdev", f"local,id={tag},path={path},security_model=none,readonly={readonly},multidevs=remap",
            "-device", f"virtio-9p-pci,fsdev={tag},mount_tag={tag}"]  # fmt: skip


def unpack(data: bytes) -> bytes:
    """Data unpacked from gzip, xz or zstd by its first bytes; other data as it is. Trailing data is ignored."""
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
        needs[_module_name(path)] = (path, others.split())
    builtin = {_module_name(line) for line in (tree / "modules.builtin").read_text().splitlines()}
    order: dict[str, None] = {}
    for name in wanted:
        if name in needs:
            itself, dependencies = needs[name]
            order |= dict.fromkeys([*reversed(dependencies), itself])  # modprobe loads the last of them first
        elif name not in builtin:
            raise BusError(f"the kernel of {tree} has no module {name}: install Debian's linux-image-amd64")
    return [tree / path for path in order]


def _module_name(path: str) -> str:
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
        name = _module_name(path.name)
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
