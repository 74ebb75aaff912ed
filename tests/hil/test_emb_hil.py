"""emb-hil: the command's world, its end and what is left; on this host where it has a vcan0, and in User-Mode Linux."""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from emb_bench.hil import uml
from emb_runtime.errors import BusError

from .conftest import EMB_HIL, Hil

PYTHON = sys.executable


@pytest.fixture
def state() -> Iterator[Path]:
    """Where emb-hil keeps what it keeps. Not tmp_path, which is too long for the path of a Unix socket."""
    with tempfile.TemporaryDirectory(prefix="hil") as directory:
        yield Path(directory)


def start(state: Path, options: tuple[str, ...], *command: str) -> subprocess.Popen[str]:
    """The command runs in a kernel, with the state directory as its last argument, so that it can be found."""
    return subprocess.Popen(
        [*EMB_HIL, "--uml", *options, "--", *command, str(state)],
        env={**os.environ, "TMPDIR": str(state)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def with_environment(environment: dict[str, str], *arguments: str) -> subprocess.CompletedProcess[str]:
    """emb-hil with these arguments, where the environment matters."""
    return subprocess.run([*EMB_HIL, *arguments], env=environment, capture_output=True, text=True, check=False)


def fake_kernel(directory: Path, script: str) -> dict[str, str]:
    program = directory / uml.PROGRAM
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    return {**os.environ, "PATH": f"{directory}:{os.environ['PATH']}"}


def processes_of(state: Path) -> list[int]:
    """Living processes with ``state`` in their command line; ended ones that wait for their parent have none."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            if os.fsencode(state) in entry.read_bytes():
                found.append(int(entry.parent.name))
    return found


def assert_nothing_left(state: Path) -> None:
    until = time.monotonic() + 20
    while processes_of(state) or any(state.iterdir()):
        assert time.monotonic() < until, (processes_of(state), list(state.iterdir()))
        time.sleep(0.05)


@pytest.mark.parametrize("options", [("--uml",), ("--uml", "--slow", "20")])
def test_the_command_runs_in_the_callers_world(
    hil: Hil, options: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "a 'b' \"c\" $HOME `d`\n\\e é"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("EMB_TEST", text)
    program = """
import json, os, sys
seen = dict(env=os.environ["EMB_TEST"], cwd=os.getcwd(), uid=os.getuid(), stdin=sys.stdin.read(), argument=sys.argv[1])
open("seen.json", "w").write(json.dumps(seen))
print("x" * 3_000_000); print("complained", file=sys.stderr); sys.exit(7)
"""
    result = hil([PYTHON, "-c", program, text], options=options)
    assert (result.returncode, len(result.stdout), result.stderr) == (7, 3_000_001, "complained\n")
    assert json.loads((tmp_path / "seen.json").read_text()) == {
        "env": text,
        "cwd": str(tmp_path),
        "uid": os.getuid(),
        "stdin": "",
        "argument": text,
    }


def test_two_processes_exchange_frames_on_vcan0_and_the_exit_status_is_a_shell_s(hil: Hil) -> None:
    program = """
import os, signal, socket, struct, time
def bus():
    sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    sock.bind(("vcan0",)); sock.settimeout(20)
    return sock
frame = struct.Struct("=IB3x8s")
mine, other = bus(), bus()
if os.fork() == 0:
    for k in range(100):
        identifier, length, data = frame.unpack(other.recv(16))
        while identifier != 0x123:
            identifier, length, data = frame.unpack(other.recv(16))
        other.send(frame.pack(0x124, length, bytes(reversed(data[:length])).ljust(8, b"\\0")))
    os._exit(0)
mine.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", 0x124, 0x7FF))
for k in range(100):
    mine.send(frame.pack(0x123, 3, bytes([k, 1, 2])))
    assert frame.unpack(mine.recv(16)) == (0x124, 3, bytes([2, 1, k]).ljust(8, b"\\0")), k
assert os.wait()[1] == 0
os.kill(os.getpid(), signal.SIGKILL)
"""
    result = hil([PYTHON, "-c", program], options=["--uml"])
    assert (result.returncode, result.stderr) == (137, "")
    assert hil(["no-such-command"], options=["--uml"]).returncode == 127


def test_signals_reach_the_command_a_deaf_one_is_ended_and_a_killed_emb_hil_leaves_nothing() -> None:
    polite = """
import signal, sys, time
def end(number, frame):
    print("got", number)
    sys.exit(9)
signal.signal(signal.SIGINT, end)
signal.signal(signal.SIGTERM, end)
print("ready", flush=True)
time.sleep(1000)
"""
    deaf = ("sh", "-c", "trap '' INT TERM; echo ready; sleep 1000; true")
    with contextlib.ExitStack() as stack:
        states = [Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hil"))) for _ in range(4)]
        # The deaf one takes its grace of 10 s, in which the others run.
        late = stack.enter_context(start(states[0], (), *deaf))
        assert late.stdout is not None
        assert late.stdout.readline() == "ready\n"
        late.send_signal(signal.SIGTERM)
        for state, number in zip(states[1:3], (signal.SIGINT, signal.SIGTERM), strict=True):
            with start(state, (), PYTHON, "-c", polite) as process:
                assert process.stdout is not None
                assert process.stdout.readline() == "ready\n"  # output comes while it runs
                process.send_signal(number)
                assert process.communicate(timeout=60)[0] == f"got {int(number)}\n"
                assert process.returncode == 9
        with start(states[3], (), *deaf) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            process.kill()
            process.wait(60)
        assert late.wait(60) == 128 + signal.SIGTERM
        for state in states:
            assert_nothing_left(state)


def test_where_vcan0_is_the_command_takes_the_place_of_emb_hil(hil: Hil) -> None:
    """Such a host is a kernel of emb-hil's own, here."""
    ours = shlex.join(EMB_HIL)
    show = f"{ours} -- sh -c 'cat; ip -br link show vcan0; exit 7'; echo $?"
    absent = f"{ours} -- no-such-command; echo $?"
    without = f"unshare --user --map-root-user --net {ours} --host -- true; echo $?"
    out = hil(["sh", "-c", "; ".join((show, absent, without))], options=["--uml"]).stdout.splitlines()
    assert out[0].startswith("vcan0")
    assert out[1:] == ["7", "127", "4"]


RUNNING = """
for word; do case $word in init=*) state=${word#init=}; state=${state%/init}; esac; done
echo running >"$state/status"
"""


@pytest.mark.parametrize(
    ("script", "options", "said"),
    [
        ("echo Kernel panic: no init; exit 0", (), ("died before the command ran", "Kernel panic: no init")),
        (RUNNING, (), ("died while the command ran",)),
        (f"{RUNNING}sleep 60", ("--slow", "2"), ("did not say 'time runs slowly'",)),
        (
            "echo xor: measuring; sleep 60",
            ("--boot", "1"),
            ("(load ", 'last: "xor: measuring"): try again', "--boot S"),
        ),
        (None, (), ("sudo apt-get install user-mode-linux",)),
    ],
    ids=["dies before", "dies under it", "does not slow down", "does not come up", "is not there"],
)
def test_a_kernel_that_fails_is_an_error_that_says_how(
    tmp_path: Path, script: str | None, options: tuple[str, ...], said: tuple[str, ...]
) -> None:
    environment = {"PATH": str(tmp_path)} if script is None else fake_kernel(tmp_path, script)
    result = with_environment(environment, "--uml", *options, "--", "true")
    assert result.returncode == 4
    assert all(words in result.stderr for words in said)
    assert result.stderr.count("\n") == 1
    assert len(result.stderr) < 300


def test_a_signal_before_the_kernel_is_up_ends_everything(state: Path, tmp_path: Path) -> None:
    environment = {**fake_kernel(tmp_path, "sleep 1000; true"), "TMPDIR": str(state)}
    with subprocess.Popen([*EMB_HIL, "--uml", "--", "true"], env=environment) as process:
        until = time.monotonic() + 60
        while not list(state.glob("*/console")):
            assert time.monotonic() < until
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
    assert_nothing_left(state)


def kernel_of(state: Path) -> int:
    """The kernel leads its process group; numbers wrap, so that a process inside may have a lower one."""
    (kernel,) = [
        pid
        for pid in processes_of(state)
        if Path(f"/proc/{pid}/comm").read_text().startswith("linux") and os.getpgid(pid) == pid
    ]
    return kernel


STOOD_STILL = """
import pathlib, sys, time
directory = pathlib.Path(sys.argv[1])
gaps, before = [], time.monotonic()
(directory / "begun").touch()
enough = False
while not enough:
    enough = (directory / "enough").exists()  # asked before the clock: it may have stood still in between
    now = time.monotonic()
    gaps.append(now - before)
    before = now
print(max(gaps))
"""
STILL_S = 1.0


@pytest.mark.parametrize("slow", [1, 100])
def test_a_computer_that_stands_still_counts_that_many_times_less_in_a_slow_kernel(state: Path, slow: int) -> None:
    (state / "there").mkdir()
    here = state / "here"  # time runs slowly wherever temporary files are
    here.symlink_to("there")
    process = start(here, ("--slow", str(slow)), PYTHON, "-c", STOOD_STILL)
    while not (here / "begun").exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    kernel = kernel_of(here)
    try:
        os.kill(kernel, signal.SIGSTOP)
        time.sleep(STILL_S)
    finally:
        os.kill(kernel, signal.SIGCONT)
        (here / "enough").touch()
    out, err = process.communicate(timeout=60)
    assert err == ""
    assert (float(out) >= 0.5 * STILL_S) == (slow == 1), out


def test_a_slow_kernel_skips_what_it_would_sleep_and_delivers_frames_before_real_time_processes(hil: Hil) -> None:
    code = """
import os, pathlib, time
a = time.monotonic(); time.sleep(10_000); print(10_000 <= time.monotonic() - a < 10_001)
for comm in pathlib.Path("/proc").glob("[0-9]*/comm"):
    if comm.read_text().startswith("ksoftirqd/"):
        print(os.sched_getscheduler(int(comm.parent.name)) == os.SCHED_FIFO)
"""
    assert hil([PYTHON, "-c", code], options=["--uml", "--slow", "20"]).stdout == "True\nTrue\n"


def test_what_the_kernel_needs_and_cannot_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BusError, match=rf"/dev/shm: .*{tempfile.gettempdir()}: "):
        uml.memory_directory(1 << 60)
    result = with_environment({**os.environ, "XDG_CACHE_HOME": str(tmp_path / "a b")}, "--slow", "2", "--", "true")
    assert result.returncode == 4
    assert "XDG_CACHE_HOME" in result.stderr
    assert result.stderr.count("\n") == 1


PTRACE = """
import ctypes, errno, os, signal, struct, sys
libc = ctypes.CDLL(None, use_errno=True)
libc.ptrace.argtypes = [ctypes.c_long, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p]
libc.ptrace.restype = ctypes.c_long
TRACEME, GETREGSET, SETREGSET, XSTATE = 0, 0x4204, 0x4205, 0x202
XMM0, BV, HEADER_END, SSE, AVX = 160, 512, 576, 2, 4

class Iovec(ctypes.Structure):
    _fields_ = [("base", ctypes.c_void_p), ("length", ctypes.c_size_t)]

def regset(request, pid, buffer):
    vector = Iovec(ctypes.cast(buffer, ctypes.c_void_p), len(buffer))
    failed = libc.ptrace(request, pid, XSTATE, ctypes.byref(vector))
    return ctypes.get_errno() if failed else buffer[: vector.length]

pid = os.fork()
if pid == 0:
    libc.ptrace(TRACEME, 0, None, None)
    os.kill(os.getpid(), signal.SIGSTOP)
    os._exit(0)
os.waitpid(pid, 0)
before = regset(GETREGSET, pid, ctypes.create_string_buffer(1 << 16))
known, = struct.unpack_from("=Q", before, BV)
given = bytearray(before[:HEADER_END])
given[XMM0 : XMM0 + 16] = bytes(range(16))
struct.pack_into("=Q", given, BV, (known | SSE) ^ AVX)  # AVX reaches beyond the prefix: not the caller's to say
result = regset(SETREGSET, pid, ctypes.create_string_buffer(bytes(given), HEADER_END))
after = regset(GETREGSET, pid, ctypes.create_string_buffer(1 << 16))
os.kill(pid, signal.SIGKILL)
if isinstance(result, int):
    print(errno.errorcode[result])
else:
    now, = struct.unpack_from("=Q", after, BV)
    print(after[XMM0 : XMM0 + 16] == bytes(range(16)), after[HEADER_END:] == before[HEADER_END:], now == known | SSE)
"""
WITH_AMX = (
    "from emb_bench.hil import cli, uml; uml.host_has_amx = lambda cpuinfo: True; cli.main(['--uml', '--', 'true'])"
)


def test_on_a_processor_with_amx_a_short_write_of_processor_state_is_completed_from_the_thread_s_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert uml.host_has_amx("processor : 0\nflags\t\t: fpu avx512f amx_tile pku\n")
    assert not uml.host_has_amx("processor : 0\nflags\t\t: fpu avx512f amx_tiles\n")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    library = uml.compiled(uml.XSTATE)
    assert library.is_relative_to(tmp_path)

    def said(environment: dict[str, str]) -> str:
        command = [PYTHON, "-c", PTRACE]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout

    assert said({**os.environ}) == "EFAULT\n"
    assert said({**os.environ, "LD_PRELOAD": str(library)}) == "True True True\n"
    subprocess.run([PYTHON, "-c", WITH_AMX], check=True, stdin=subprocess.DEVNULL)  # the kernel starts with it
