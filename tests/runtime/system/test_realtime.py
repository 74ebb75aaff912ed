"""Idle states of the processor are held off as long as the process lives, where the kernel lets it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from emb_runtime.system import realtime


@pytest.fixture
def device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A file in place of the device; nothing that a test opens stays open."""
    monkeypatch.setattr(realtime, "_awake", None)
    monkeypatch.setattr(realtime, "WAKE_UP_LATENCY", str(tmp_path / "cpu_dma_latency"))
    yield tmp_path / "cpu_dma_latency"
    if realtime._awake is not None:
        os.close(realtime._awake)


def test_a_latency_of_zero_is_asked_for_once_and_stays_asked_for(device: Path) -> None:
    device.touch()
    assert realtime._stay_awake() == "none that takes time to leave"
    held = realtime._awake
    assert held is not None
    assert Path(f"/proc/self/fd/{held}").readlink() == device
    assert realtime._stay_awake() == "none that takes time to leave"
    assert device.read_bytes() == bytes(4)
    assert realtime._awake == held


def test_a_kernel_without_the_device_lacks_nothing(device: Path) -> None:
    assert realtime._stay_awake() == "not managed by this kernel"


def test_a_device_that_cannot_be_opened_is_not_obtained(device: Path) -> None:
    device.mkdir()
    assert realtime._stay_awake() == f"not obtained: {device}: Is a directory"


def test_a_device_that_refuses_the_value_is_not_left_open(device: Path) -> None:
    device.symlink_to("/dev/full")
    before = len(list(Path("/proc/self/fd").iterdir()))
    assert realtime._stay_awake() == f"not obtained: {device}: No space left on device"
    assert realtime._awake is None
    assert len(list(Path("/proc/self/fd").iterdir())) == before
