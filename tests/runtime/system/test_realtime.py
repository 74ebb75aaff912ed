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
    for descriptor in held(tmp_path / "cpu_dma_latency"):
        os.close(descriptor)


def held(device: Path) -> list[int]:
    """Descriptors of this process that are open on a file."""
    return [int(link.name) for link in Path("/proc/self/fd").iterdir() if link.exists() and link.readlink() == device]


def test_a_latency_of_zero_is_asked_for_once_and_stays_asked_for(device: Path) -> None:
    device.touch()
    assert realtime.stay_awake() == "none that takes time to leave"
    (descriptor,) = held(device)
    assert realtime.stay_awake() == "none that takes time to leave"
    assert device.read_bytes() == bytes(4)
    assert held(device) == [descriptor]


def test_a_kernel_without_the_device_lacks_nothing(device: Path) -> None:
    assert realtime.stay_awake() == "not managed by this kernel"


def test_a_device_that_cannot_be_opened_is_not_obtained(device: Path) -> None:
    device.mkdir()
    assert realtime.stay_awake() == f"not obtained: {device}: Is a directory"


def test_a_device_that_refuses_the_value_is_not_left_open(device: Path) -> None:
    device.symlink_to("/dev/full")
    before = len(list(Path("/proc/self/fd").iterdir()))
    assert realtime.stay_awake() == f"not obtained: {device}: No space left on device"
    assert len(list(Path("/proc/self/fd").iterdir())) == before
