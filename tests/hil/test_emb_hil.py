from __future__ import annotations

import contextlib
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from emb_bench.hil import host, uml
from emb_runtime.errors import BusError

from .conftest import EMB_HIL, Hil
from .driver import children
from .leftovers import assert_nothing_left

PYTHON = sys.executable


def places() -> list[tuple[str, ...]]:
    """Wherever this machine can have a vcan0. Where it has none, the kernel: so that the tests fail with its line."""
    found: list[tuple[str, ...]] = []
    with contextlib.suppress(BusError), host.interface():
        found.append(("--host",))
    if shutil.which(uml.PROGRAM) is not None or not found:
        found.append(("--uml",))
    return found


PLACES = places()
everywhere = pytest.mark.parametrize("place", PLACES, ids=" ".join)


@pytest.fixture(scope="module", autouse=True)
def deaf() -> Iterator[dict[tuple[str, ...], tuple[subprocess.Popen[str], Path]]]:
    """A command for each place that ignores its time limit: started first, because it takes its grace of 10 s."""
    with contextlib.ExitStack() as stack:
        found = {}
        for place in PLACES:
            state = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hil")))
            command = ("sh", "-c", "trap '' INT TERM; sleep 1000; true")
            found[place] = stack.enter_context(start(state, (*place, "--timeout", "4"), *command)), state
        yield found


@pytest.fixture
def state() -> Iterator[Path]:
    """Where emb-hil keeps what it keeps. Not tmp_path, which is too long for the path of a Unix socket."""
    with tempfile.TemporaryDirectory(prefix="hil") as directory:
        yield Path(directory)


def start(state: Path, place: tuple[str, ...], *command: str) -> subprocess.Popen[str]:
    """The command runs at ``place``, with the state directory as its last argument, so that it can be found."""
    return subprocess.Popen(
        [*EMB_HIL, *place, "--", *command, str(state)],
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


@pytest.mark.parametrize(
    "place",
    [*PLACES, *(("--uml", *more) for more in (("--shim", "always"), ("--slow", "20")) if ("--uml",) in PLACES)],
    ids=" ".join,
)
def test_the_command_runs_in_the_callers_world(
    hil: Hil, place: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "a 'b' \"c\" $HOME `d`\n\\e é"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("EMB_TEST", text)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    program = """
import json, os, sys
seen = dict(env=os.environ["EMB_TEST"], cwd=os.getcwd(), uid=os.getuid(), stdin=sys.stdin.read(), argument=sys.argv[1])
open("seen.json", "w").write(json.dumps(seen))
print("said"); print("complained", file=sys.stderr); sys.exit(7)
"""
    result = hil([PYTHON, "-c", program, text], options=place)
    assert (result.returncode, result.stdout, result.stderr) == (7, "said\n", "complained\n")
    assert json.loads((tmp_path / "seen.json").read_text()) == {
        "env": text,
        "cwd": str(tmp_path),
        "uid": os.getuid(),
        "stdin": "",
        "argument": text,
    }


@everywhere
@pytest.mark.parametrize(
    ("command", "status"),
    [(["sh", "-c", "kill -9 $$"], 137), (["no-such-command"], 127)],
)
def test_the_exit_status_is_that_of_a_shell(hil: Hil, place: tuple[str, ...], command: list[str], status: int) -> None:
    assert hil(command, options=place).returncode == status


def test_time_that_does_not_run_slowly_although_it_should_is_an_error(tmp_path: Path) -> None:
    script = """
        for word; do case $word in init=*) state=${word#init=}; state=${state%/init}; esac; done
        echo running >"$state/status"; sleep 60
    """
    result = with_environment(fake_kernel(tmp_path, script), "--slow", "2", "--", "true")
    assert result.returncode == 4
    assert "did not say 'time runs slowly'" in result.stderr


def test_time_runs_slowly_wherever_temporary_files_are(state: Path) -> None:
    (state / "there").mkdir()
    (state / "here").symlink_to("there")
    result = with_environment(
        {**os.environ, "TMPDIR": str(state / "here")}, "--slow", "2", "--timeout", "100", "--", "true"
    )
    assert (result.returncode, result.stderr) == (0, "")


def test_a_library_that_cannot_be_loaded_from_where_it_lies_is_refused(tmp_path: Path) -> None:
    result = with_environment({**os.environ, "XDG_CACHE_HOME": str(tmp_path / "a b")}, "--slow", "2", "--", "true")
    assert result.returncode == 4
    assert "XDG_CACHE_HOME" in result.stderr
    assert result.stderr.count("\n") == 1


@everywhere
def test_two_processes_exchange_frames_on_vcan0(hil: Hil, place: tuple[str, ...]) -> None:
    program = """
import os, socket, struct
def bus():
    sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    sock.bind(("vcan0",)); sock.settimeout(20)
    return sock
frame = struct.Struct("=IB3x8s")
mine = bus()
if os.fork() == 0:
    other = bus()
    for k in range(100):
        identifier, length, data = frame.unpack(other.recv(16))
        other.send(frame.pack(identifier + 1, length, bytes(reversed(data[:length])).ljust(8, b"\\0")))
    os._exit(0)
mine.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", 0x124, 0x7FF))
import time; time.sleep(1)  # until the other one listens
for k in range(100):
    mine.send(frame.pack(0x123, 3, bytes([k, 1, 2])))
    assert frame.unpack(mine.recv(16)) == (0x124, 3, bytes([2, 1, k]).ljust(8, b"\\0")), k
assert os.wait()[1] == 0
print("answered")
"""
    result = hil([PYTHON, "-c", program], options=place)
    assert (result.returncode, result.stdout) == (0, "answered\n"), result.stderr


@everywhere
def test_output_comes_whole_and_while_the_command_runs(state: Path, place: tuple[str, ...], tmp_path: Path) -> None:
    go = tmp_path / "go"
    program = """
import os, sys, time
print("ready", flush=True)
while not os.path.exists(sys.argv[1]):
    time.sleep(0.05)
print("x" * 3_000_000)
"""
    with start(state, place, PYTHON, "-c", program, str(go)) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        go.touch()
        output, errors = process.communicate(timeout=60)
    assert (process.returncode, errors, len(output), set(output)) == (0, "", 3_000_001, {"x", "\n"})


@everywhere
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_reaches_the_command_which_may_end_its_own_way(
    state: Path, place: tuple[str, ...], number: signal.Signals
) -> None:
    program = """
import signal, sys, time
def end(number, frame):
    print("got", number)
    sys.exit(9)
signal.signal(int(sys.argv[1]), end)
print("ready", flush=True)
time.sleep(1000)
"""
    with start(state, place, PYTHON, "-c", program, str(int(number))) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(number)
        assert process.communicate(timeout=60)[0] == f"got {int(number)}\n"
        assert process.returncode == 9
    assert_nothing_left(state)


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


@everywhere
def test_a_killed_emb_hil_leaves_nothing_behind(state: Path, place: tuple[str, ...]) -> None:
    with start(state, place, "sh", "-c", "echo ready; sleep 1000; true") as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.kill()
        process.wait(60)
    assert_nothing_left(state)


def test_the_host_keeps_an_interface_that_was_there_and_loses_one_that_was_made(hil: Hil) -> None:
    show = "import socket; print([name for _, name in socket.if_nameindex() if name == 'vcan0'])"
    on_host = [*EMB_HIL, "--host", "--", PYTHON, "-c", show]
    script = f"{shlex.join(on_host)}; {shlex.join([PYTHON, '-c', show])}"
    assert hil(["sh", "-c", script]).stdout.splitlines() == ["['vcan0']", "['vcan0']"]
    # A network namespace of one's own has none yet, and an ordinary user may make one there.
    made = hil(["unshare", "--user", "--map-root-user", "--net", "sh", "-c", script], options=PLACES[-1])
    assert made.stdout.splitlines() == ["['vcan0']", "[]"], made.stderr


def test_a_missing_kernel_is_one_line_that_says_what_to_install(tmp_path: Path) -> None:
    result = with_environment({"PATH": str(tmp_path)}, "--uml", "--", "true")
    assert result.returncode == 4
    assert result.stderr.count("\n") == 1
    assert "sudo apt-get install user-mode-linux" in result.stderr


def test_a_kernel_that_dies_before_the_command_is_an_error_with_its_last_words(tmp_path: Path) -> None:
    result = with_environment(fake_kernel(tmp_path, "echo Kernel panic: no init; exit 0"), "--uml", "--", "true")
    assert result.returncode == 4
    assert "died before the command ran" in result.stderr
    assert "Kernel panic: no init" in result.stderr


def test_a_kernel_that_dies_under_the_command_is_an_error(tmp_path: Path) -> None:
    script = """
        for word; do case $word in init=*) state=${word#init=}; state=${state%/init}; esac; done
        echo running >"$state/status"
    """
    result = with_environment(fake_kernel(tmp_path, script), "--uml", "--", "true")
    assert result.returncode == 4
    assert "died while the command ran" in result.stderr


@pytest.mark.parametrize(
    "arguments",
    [[], ["--"], ["true"], ["--timeout", "0", "--", "true"], ["--timeout", "nan", "--", "true"],
     ["--memory", "1", "--", "true"], ["--slow", "0", "--", "true"], ["--slow", "1001", "--", "true"],
     ["--slow", "2", "--qemu", "--", "true"], ["--slow", "2", "--host", "--", "true"],
     ["--slow", "x", "--", "true"], ["--host", "--uml", "--", "true"]],
)  # fmt: skip
def test_wrong_usage_is_told_apart_from_everything_else(arguments: list[str]) -> None:
    result = with_environment({**os.environ}, *arguments)
    assert result.returncode == 2
    assert "Traceback" not in result.stderr


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
    process = start(state, ("--uml", "--slow", str(slow)), PYTHON, "-c", STOOD_STILL)
    while not (state / "begun").exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    (kernel,) = (pid for pid in children(process.pid) if uml.PROGRAM in Path(f"/proc/{pid}/cmdline").read_text())
    try:
        os.kill(kernel, signal.SIGSTOP)
        time.sleep(STILL_S)
    finally:
        os.kill(kernel, signal.SIGCONT)
        (state / "enough").touch()
    out, err = process.communicate(timeout=60)
    assert err == ""
    assert (float(out) >= 0.5 * STILL_S) == (slow == 1), out


def test_a_slow_kernel_skips_what_it_would_sleep(hil: Hil) -> None:
    code = "import time; a = time.monotonic(); time.sleep(10_000); print(10_000 <= time.monotonic() - a < 10_001)"
    assert hil([PYTHON, "-c", code], options=["--uml", "--slow", "20"]).stdout == "True\n"


def test_memory_that_fits_nowhere_is_refused_with_every_place_that_was_tried() -> None:
    with pytest.raises(BusError, match=rf"/dev/shm: .*{tempfile.gettempdir()}: "):
        uml.memory_directory(1 << 60)


@pytest.mark.parametrize(("flags", "amx"), [("fpu avx512f amx_tile pku", True), ("fpu avx512f amx_tiles", False)])
def test_amx_is_recognised_by_its_flag(flags: str, amx: bool) -> None:
    assert uml.host_has_amx(f"processor : 0\nflags\t\t: {flags}\n") is amx


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


def test_a_short_write_of_processor_state_is_completed_from_the_threads_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    library = uml.compiled(uml.XSTATE)
    assert library.is_relative_to(tmp_path)

    def said(environment: dict[str, str]) -> str:
        command = [PYTHON, "-c", PTRACE]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout

    assert said({**os.environ}) == "EFAULT\n"
    assert said({**os.environ, "LD_PRELOAD": str(library)}) == "True True True\n"


def test_received_frames_do_not_wait_for_real_time_processes(hil: Hil) -> None:
    code = (
        "import os, pathlib\n"
        "for comm in pathlib.Path('/proc').glob('[0-9]*/comm'):\n"
        "    if comm.read_text().startswith('ksoftirqd/'):\n"
        "        print(os.sched_getscheduler(int(comm.parent.name)) == os.SCHED_FIFO)\n"
    )
    result = hil([sys.executable, "-c", code], options=["--uml"])
    assert result.stdout == "True\n"


@everywhere
def test_the_time_limit_ends_even_a_deaf_command_and_leaves_nothing(
    deaf: dict[tuple[str, ...], tuple[subprocess.Popen[str], Path]], place: tuple[str, ...]
) -> None:
    process, state = deaf[place]
    assert process.wait(60) == 124
    assert_nothing_left(state)
