"""``emb-hil --qemu`` and every fault that can be brought about in it, seen from plain sockets. One kernel for all."""

from __future__ import annotations

import gzip
import json
import lzma
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import zstandard

from emb_bench.hil import qemu
from emb_runtime.errors import BusError

from .conftest import EMB_HIL
from .leftovers import assert_nothing_left

PRIMITIVES = Path(__file__).with_name("primitives.py")
TEXT = "a 'b' \"c\" $HOME `d`\n\\e é"
BOOT_S = 400.0


def qemu_command(*command: str, options: Sequence[str] = ()) -> list[str]:
    return [*EMB_HIL, "--qemu", *options, "--", *command]


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> tuple[subprocess.CompletedProcess[str], Path]:
    """What came of the primitives, run once, in a directory with a name that nobody would choose."""
    folder = tmp_path_factory.mktemp("qemu") / "a, 'b' c"
    folder.mkdir()
    program = [sys.executable, str(PRIMITIVES), "out.json", TEXT]
    with (
        tempfile.TemporaryDirectory(prefix="hil") as state,
        subprocess.Popen(
            qemu_command(*program, options=("--root", "--timeout", str(BOOT_S))),
            cwd=folder,
            env={**os.environ, "TMPDIR": state, "EMB_TEST": TEXT, "EMB_OUTSIDE": str(folder.parent / "outside")},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as process,
    ):
        assert process.stdout is not None
        said = process.stdout.readline() + process.stdout.readline()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=BOOT_S)
        assert process.returncode != 4, f"no QEMU for the hardware-in-the-loop tests: {err}"
        assert_nothing_left(Path(state))
    return subprocess.CompletedProcess(process.args, process.returncode, said + out, err), folder


@pytest.fixture(scope="module")
def saw(ran: tuple[subprocess.CompletedProcess[str], Path]) -> dict[str, Any]:
    result, folder = ran
    assert (folder / "out.json").exists(), result.stderr
    return dict(json.loads((folder / "out.json").read_text()))


pytestmark = pytest.mark.timeout(500)


def test_the_command_runs_in_the_callers_world(
    ran: tuple[subprocess.CompletedProcess[str], Path], saw: dict[str, Any]
) -> None:
    result, folder = ran
    assert (result.returncode, result.stderr) == (7, "complained\n")
    world = saw["world"]
    assert world.pop("release").startswith(qemu.find_kernel()[0].name.removeprefix("vmlinuz-"))  # type: ignore[index]
    assert abs(world.pop("time") - time.time()) < 86400
    assert world == {
        "host": socket.gethostname(),
        "uid": 0,
        "cwd": str(folder),
        "word": TEXT,
        "env": TEXT,
        "stdin": "",
        "outside": "inside\n",
    }


def test_what_is_written_outside_the_working_directory_stays_in_the_kernel(
    ran: tuple[subprocess.CompletedProcess[str], Path], saw: dict[str, Any]
) -> None:
    assert saw["world"]["outside"] == "inside\n"
    assert not (ran[1].parent / "outside").exists()


def delays(traffic: dict[str, Any]) -> list[float]:
    """Seconds from sending to each frame that arrived."""
    return [(at - traffic["sent"][number]) / 1e9 for at, _, number in traffic["seen"]]


def numbers(traffic: dict[str, Any]) -> list[int]:
    return [number for *_, number in traffic["seen"]]


@pytest.mark.parametrize("name", ["plain", "healed"])
def test_a_sound_bus_brings_every_frame_once_and_in_order_at_once(saw: dict[str, Any], name: str) -> None:
    assert numbers(saw[name]) == list(range(50))
    # Virtual time: whatever else this machine does, no frame takes longer.
    assert max(delays(saw[name])) < 100e-6


def test_a_delay_holds_for_every_frame(saw: dict[str, Any]) -> None:
    assert numbers(saw["delay"]) == list(range(50))
    assert all(5.0e-3 <= delay < 5.1e-3 for delay in delays(saw["delay"]))


def binomial_bounds(count: int, probability: float) -> tuple[float, float]:
    """Six standard deviations to either side."""
    spread = 6 * (count * probability * (1 - probability)) ** 0.5
    return count * probability - spread, count * probability + spread


def test_loss_takes_its_share_and_leaves_the_rest_in_order(saw: dict[str, Any]) -> None:
    low, high = binomial_bounds(400, 0.7)
    assert low < len(saw["loss"]["seen"]) < high
    assert numbers(saw["loss"]) == sorted(set(numbers(saw["loss"])))


def test_duplication_doubles_its_share_and_loses_none(saw: dict[str, Any]) -> None:
    low, high = binomial_bounds(400, 0.3)
    assert low < len(saw["duplicate"]["seen"]) - 400 < high
    assert set(numbers(saw["duplicate"])) == set(range(400))
    assert max(numbers(saw["duplicate"]).count(number) for number in range(400)) == 2


def test_reordering_lets_its_share_overtake_and_loses_none(saw: dict[str, Any]) -> None:
    low, high = binomial_bounds(400, 0.25)
    assert sorted(numbers(saw["reorder"])) == list(range(400))
    assert low < sum(delay < 1e-3 for delay in delays(saw["reorder"])) < high
    assert numbers(saw["reorder"]) != sorted(numbers(saw["reorder"]))


def test_jitter_stays_in_its_bounds_and_loses_none(saw: dict[str, Any]) -> None:
    assert sorted(numbers(saw["jitter"])) == list(range(400))
    assert all(0.9e-3 < delay < 9.1e-3 for delay in delays(saw["jitter"]))
    assert max(delays(saw["jitter"])) - min(delays(saw["jitter"])) > 4e-3


@pytest.mark.parametrize("name", ["refused", "refused_by_controller"])
def test_a_full_queue_refuses_frames_until_it_empties(saw: dict[str, Any], name: str) -> None:
    assert saw[name] == {"accepted": 4, "failure": "ENOBUFS", "again": "", "seen": [0, 1, 2, 3, 100]}


def test_a_route_corrupts_one_identifier_in_one_direction(saw: dict[str, Any]) -> None:
    corrupted = 1 ^ int.from_bytes(b"\xff\0\0\0\0\0\0\x01", "little")
    assert saw["routed"] == {
        "vcan0": [[0x100, 1], [0x101, 2]],
        "vcan1": [[0x100, corrupted], [0x100, 3], [0x102, 4]],
        "after": 0,
    }


def test_two_joined_buses_are_one_except_for_the_corrupted_identifier(saw: dict[str, Any]) -> None:
    assert saw["joined"] == {
        "vcan0": [[0x100, 1], [0x101, 2], [0x100, 3 ^ 0xFF], [0x102, 4]],
        "vcan1": [[0x100, 1 ^ 0xFF], [0x101, 2], [0x100, 3], [0x102, 4]],
        "after": 0,
    }


@pytest.mark.parametrize(("name", "other"), [("vcan0_down", "ENETDOWN"), ("can0_down", "EAGAIN")])
def test_a_link_that_is_down_says_so_once_and_carries_again_when_up(saw: dict[str, Any], name: str, other: str) -> None:
    assert saw[name] == {
        "first": "ENETDOWN",
        "then": "EAGAIN",
        "send": "ENETDOWN",
        "other": other,
        "up": [False, True],
        "seen": [2],
    }


def test_the_controllers_are_on_one_bus_and_tell_their_state(saw: dict[str, Any]) -> None:
    assert saw["controllers"] == {
        "at_start": [["ERROR_ACTIVE", qemu.BITRATE, 0, 0]] * 2,
        "seen": list(range(50)),
        "busy": "EBUSY",
        "down": ["STOPPED", 500_000, 0, 0],
        "up": ["ERROR_ACTIVE", 500_000, 0, 0],
    }


def test_a_controller_can_be_made_to_report_that_it_went_off_the_bus(saw: dict[str, Any]) -> None:
    assert saw["bus_off"] == [0x20000040, 0x20000100]  # CAN_ERR_FLAG with CAN_ERR_BUSOFF, with CAN_ERR_RESTARTED


def test_a_small_disk_takes_its_size_and_no_more(saw: dict[str, Any]) -> None:
    assert saw["disk"] == {"written": 64 << 10, "failure": "ENOSPC", "left": 0}


def test_a_clock_step_moves_the_time_of_day_alone(saw: dict[str, Any]) -> None:
    assert saw["clock"] == pytest.approx([3600.0, -3600.0], abs=1e-3)


@pytest.fixture
def state() -> Iterator[Path]:
    """Where emb-hil keeps what it keeps. Not tmp_path, which is too long for the path of a Unix socket."""
    with tempfile.TemporaryDirectory(prefix="hil") as directory:
        yield Path(directory)


def test_a_signal_reaches_the_command_which_may_end_its_own_way(
    ran: tuple[subprocess.CompletedProcess[str], Path],
) -> None:
    assert (ran[0].returncode, ran[0].stdout) == (7, "said\nready\ninterrupted\n")


def test_a_killed_emb_hil_leaves_nothing_behind(state: Path, tmp_path: Path) -> None:
    with subprocess.Popen(
        qemu_command("true"),
        cwd=tmp_path,
        env={**os.environ, "TMPDIR": str(state)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        until = time.monotonic() + 60
        while not list(state.glob("*/monitor")):  # the kernel boots
            assert time.monotonic() < until
            time.sleep(0.01)
        process.kill()
        process.wait(60)
    assert_nothing_left(state)


def test_the_time_limit_ends_a_kernel_that_still_boots(state: Path, tmp_path: Path) -> None:
    result = subprocess.run(
        qemu_command("true", options=("--timeout", "1")),
        cwd=tmp_path,
        env={**os.environ, "TMPDIR": str(state)},
        check=False,
    )
    assert result.returncode == 124
    assert_nothing_left(state)


def test_a_kernel_that_dies_under_the_command_is_an_error_with_its_last_words(tmp_path: Path) -> None:
    crash = qemu_command("sh", "-c", "echo said; echo c >/proc/sysrq-trigger; sleep 1000", options=["--root"])
    result = subprocess.run(crash, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (4, "said\n")
    assert "QEMU: the kernel died while the command ran" in result.stderr
    assert "sysrq" in result.stderr


def test_what_is_missing_is_one_line_that_says_what_to_install(tmp_path: Path) -> None:
    result = subprocess.run(
        qemu_command("true"), env={"PATH": str(tmp_path)}, capture_output=True, text=True, check=False
    )
    assert result.returncode == 4
    assert result.stderr.count("\n") == 1
    assert "sudo apt-get install qemu-system-x86 busybox-static`" in result.stderr


@pytest.mark.parametrize("directory", ["/", "/dev/shm"])
def test_a_directory_that_is_the_kernels_own_cannot_be_the_working_one(directory: str) -> None:
    result = subprocess.run(qemu_command("true"), cwd=directory, capture_output=True, text=True, check=False)
    assert result.returncode == 4
    assert f"cannot be {directory}:" in result.stderr


def test_the_newest_kernel_that_has_its_modules_is_taken(tmp_path: Path) -> None:
    assert qemu.find_kernel(tmp_path) is None
    (tmp_path / "boot").mkdir()
    for version in ("6.1.0-9-amd64", "6.1.0-56-amd64", "6.2.0-1-amd64"):
        (tmp_path / "boot" / f"vmlinuz-{version}").touch()
    for version in ("6.1.0-9-amd64", "6.1.0-56-amd64"):
        tree = tmp_path / "lib" / "modules" / version
        tree.mkdir(parents=True)
        (tree / "modules.dep").touch()
    newest = "6.1.0-56-amd64"
    assert qemu.find_kernel(tmp_path) == (
        tmp_path / "boot" / f"vmlinuz-{newest}",
        tmp_path / "lib" / "modules" / newest,
    )


def test_modules_are_loaded_after_what_they_need(tmp_path: Path) -> None:
    (tmp_path / "modules.dep").write_text(
        "kernel/a.ko:\nkernel/b-c.ko.xz: kernel/a.ko\nkernel/d.ko: kernel/b-c.ko.xz kernel/a.ko\nkernel/e.ko:\n"
    )
    (tmp_path / "modules.builtin").write_text("kernel/net/f-g.ko\n")
    order = qemu.load_order(tmp_path, ["f_g", "d", "b_c"])
    assert order == [tmp_path / "kernel" / name for name in ("a.ko", "b-c.ko.xz", "d.ko")]
    with pytest.raises(BusError, match="no module h"):
        qemu.load_order(tmp_path, ["h"])


@pytest.mark.parametrize("pack", [gzip.compress, lzma.compress, zstandard.compress, bytes])
def test_packed_data_is_unpacked_by_its_first_bytes(pack: Any) -> None:
    data = b"\x7fELF" + bytes(1000)
    assert qemu.unpack(pack(data)) == data


def test_an_image_that_holds_no_program_is_refused() -> None:
    with pytest.raises(BusError, match="no ELF program"):
        qemu.vmlinux(bytes(4096))
