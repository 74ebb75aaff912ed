"""The command frame's enable bit, and the currents that lie on its steps."""

from __future__ import annotations

import pytest

from emb_runtime.can.messages import load_layout
from emb_runtime.errors import FrameError
from emb_runtime.records import CurrentCommand

LAYOUT = load_layout()


@pytest.mark.parametrize("enable", [False, True])
def test_the_enable_bit_is_read_as_it_was_written(enable: bool) -> None:
    command = CurrentCommand(3, 4, 0.0, enable)
    assert LAYOUT.decode_command(LAYOUT.encode_command(command)) == command


@pytest.mark.parametrize(
    ("limit", "within"), [(6.0, 30_000), (0.6, 3_000), (1.0001, 5_000), (1.00019, 5_000), (0.0002, 1), (0.0001, 0)]
)
def test_the_current_within_a_limit_lies_on_a_step_of_the_signal(limit: float, within: int) -> None:
    assert LAYOUT.current_within(limit) == pytest.approx(within * 2e-4, abs=1e-12)
    assert LAYOUT.current_within(limit) <= limit + 1e-9


def test_a_limit_that_a_decimal_fraction_puts_just_below_a_step_counts_as_the_step() -> None:
    below = [n for n in range(1, 30_001) if (n / 5000) / 2e-4 < n]
    assert below
    assert [round(LAYOUT.current_within(n / 5000) / 2e-4) for n in below] == below


def with_time_step(step: str, most: str) -> int:
    text = LAYOUT.text.replace("(0.00000025,0) [0|4.19430375]", f"({step},0) [0|{most}]")
    return load_layout(text).device_time_step_ns


@pytest.mark.parametrize("step_ns", range(1, 60))
def test_a_time_step_of_any_whole_nanoseconds_is_taken(step_ns: int) -> None:
    assert with_time_step(f"{step_ns}e-9", "0.001") == step_ns


@pytest.mark.parametrize("step", ["1.5e-9", "0.6e-9", "0.4e-9", "250.4e-9"])
def test_a_time_step_between_nanoseconds_is_refused(step: str) -> None:
    with pytest.raises(FrameError, match="whole nanoseconds"):
        with_time_step(step, "0.001")


@pytest.mark.parametrize("values", ["VAL_ 257 NodeState 0", "VAL_ 258 NodeState 0", "VAL_ 258 StopReason 0"])
def test_each_table_of_values_must_say_what_ours_says(values: str) -> None:
    assert LAYOUT.text.count(values) == 1
    with pytest.raises(FrameError, match="expected the values"):
        load_layout(LAYOUT.text.replace(values, values[:-1] + "7"))
