"""Confinement of a process that handles what nobody vouches for: little memory, little time, no files, no network.

The limits on memory and time hold everywhere, for each process: a copy that it makes of itself has them anew, and
cannot be refused, as threads need the same call. The filter of system calls needs a kernel with seccomp, on x86-64 or
64-bit ARM; elsewhere the process keeps the rights of its user. It lists what is refused; a kernel's other calls are
allowed.
"""

from __future__ import annotations

import ctypes
import math
import os
import platform
import signal
import struct
from pathlib import Path

_PR_SET_PDEATHSIG, _PR_SET_SECCOMP, _PR_SET_NO_NEW_PRIVS = 1, 22, 38
_SECCOMP_MODE_FILTER = 2

# Classic BPF over struct seccomp_data: number of the call at 0, architecture at 4, third argument at 32.
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_ALLOW, _REFUSE = 0x7FFF0000, 0x00050000 | 1  # SECCOMP_RET_ERRNO with EPERM


def _numbers(calls: str) -> tuple[int, ...]:
    return tuple(map(int, calls.split()[1::2]))


_REFUSED = {
    "x86_64": (
        0xC000003E,
        257,
        _numbers(
            "open 2 openat2 437 creat 85 truncate 76 rename 82 renameat 264 renameat2 316 unlink 87 unlinkat 263 "
            "rmdir 84 mkdir 83 mkdirat 258 link 86 linkat 265 symlink 88 symlinkat 266 chmod 90 fchmodat 268 "
            "mknod 133 mknodat 259 socket 41 socketpair 53 connect 42 bind 49 accept 43 accept4 288 sendto 44 "
            "sendmsg 46 sendmmsg 307 fork 57 vfork 58 execve 59 execveat 322 kill 62 tkill 200 "
            "pidfd_send_signal 424 ptrace 101 process_vm_readv 310 process_vm_writev 311 io_uring_setup 425 "
            "prlimit64 302 setrlimit 160 fchmod 91 fchmodat2 452 chown 92 fchown 93 lchown 94 fchownat 260 utime 132 "
            "utimes 235 futimesat 261 utimensat 280 setxattr 188 lsetxattr 189 fsetxattr 190 setxattrat 463 "
            "removexattr 197 lremovexattr 198 fremovexattr 199 removexattrat 466 open_by_handle_at 304 mount 165 "
            "umount2 166 tgkill 234 rt_sigqueueinfo 129 rt_tgsigqueueinfo 297 pidfd_open 434 pidfd_getfd 438 "
            "io_uring_enter 426 io_uring_register 427 "
        ),
    ),
    "aarch64": (
        0xC00000B7,
        56,
        _numbers(
            "openat2 437 truncate 45 renameat 38 renameat2 276 unlinkat 35 mkdirat 34 linkat 37 symlinkat 36 "
            "fchmodat 53 mknodat 33 socket 198 socketpair 199 connect 203 bind 200 accept 202 accept4 242 "
            "sendto 206 sendmsg 211 sendmmsg 269 execve 221 execveat 281 kill 129 tkill 130 pidfd_send_signal 424 "
            "ptrace 117 process_vm_readv 270 process_vm_writev 271 io_uring_setup 425 prlimit64 261 setrlimit 164 "
            "fchmod 52 fchmodat2 452 fchown 55 fchownat 54 utimensat 88 setxattr 5 lsetxattr 6 fsetxattr 7 "
            "setxattrat 463 removexattr 14 lremovexattr 15 fremovexattr 16 removexattrat 466 open_by_handle_at 265 "
            "mount 40 umount2 39 tgkill 131 rt_sigqueueinfo 138 rt_tgsigqueueinfo 240 pidfd_open 434 "
            "pidfd_getfd 438 io_uring_enter 426 io_uring_register 427 "
        ),
    ),
}
"""By machine: its AUDIT_ARCH, the number of openat, which may only read, and of the calls that are refused."""
_X32 = 0x40000000  # Numbers from here on are the same calls once more, on x86-64


def end_with(parent: int) -> None:
    """End this process when the one that started it ends.

    Args:
        parent: its process id.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_PDEATHSIG, ctypes.c_ulong(signal.SIGKILL), *_zeros(3))
    if os.getppid() != parent:  # it was gone before
        os._exit(1)


def confine(memory: int, seconds: float) -> bool:
    """Confine this process for good. It can compute, and use the files that it has open.

    Args:
        memory: bytes that it may take besides those that it has.
        seconds: processor time that it may take besides what it has taken; rounded up to whole seconds.

    Returns:
        True if system calls are filtered too.
    """
    import resource  # Linux only, as all of this

    def limit(which: int, value: int) -> None:
        """Set a limit, unless there is a narrower one."""
        _, most = resource.getrlimit(which)
        value = value if most == resource.RLIM_INFINITY else min(value, most)
        resource.setrlimit(which, (value, value))

    libc = ctypes.CDLL(None, use_errno=True)
    used = resource.getrusage(resource.RUSAGE_SELF)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit(resource.RLIMIT_AS, pages * resource.getpagesize() + memory)
    limit(resource.RLIMIT_CPU, math.ceil(used.ru_utime + used.ru_stime + seconds))
    limit(resource.RLIMIT_FSIZE, 0)
    limit(resource.RLIMIT_CORE, 0)
    return _filter_calls(libc)


def _filter_calls(libc: ctypes.CDLL) -> bool:
    if platform.machine() not in _REFUSED:
        return False
    architecture, openat, numbers = _REFUSED[platform.machine()]
    count = len(numbers)
    program = b"".join(
        (
            _instruction(_LOAD, 4),
            _instruction(_EQUAL, architecture, equal=1),
            _instruction(_RETURN, _REFUSE),
            _instruction(_LOAD, 0),
            *(_instruction(_EQUAL, n, equal=count + 4 - k) for k, n in enumerate(numbers)),
            _instruction(_AT_LEAST, _X32, equal=4),
            _instruction(_EQUAL, openat, other=2),
            _instruction(_LOAD, 32),
            _instruction(_ANY_BIT, os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC, equal=1),
            _instruction(_RETURN, _ALLOW),
            _instruction(_RETURN, _REFUSE),
        )
    )
    kept = ctypes.create_string_buffer(program, len(program))
    head = ctypes.create_string_buffer(struct.pack("@HxxxxxxP", len(program) // 8, ctypes.addressof(kept)))
    if libc.prctl(_PR_SET_NO_NEW_PRIVS, ctypes.c_ulong(1), *_zeros(3)) != 0:
        return False
    return bool(libc.prctl(_PR_SET_SECCOMP, ctypes.c_ulong(_SECCOMP_MODE_FILTER), head, *_zeros(2)) == 0)


def _instruction(code: int, value: int, equal: int = 0, other: int = 0) -> bytes:
    """One instruction: so many are passed over if the comparison holds, and if not."""
    return struct.pack("@HBBI", code, equal, other, value)


def _zeros(count: int) -> tuple[ctypes.c_ulong, ...]:
    """The arguments that must be zero, as long as the kernel reads them."""
    return (ctypes.c_ulong(0),) * count
