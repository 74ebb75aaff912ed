"""The state machine: every pair of state and event, against the picture drawn by hand."""

from __future__ import annotations

import pytest

from emb_runtime.errors import EXIT_BUS, EXIT_SAFETY_STOP
from emb_runtime.records import RunState
from emb_runtime.states import FAULTS, Event, Fault, may_enable, may_send, next_state

# state:        PREPARED  NODE_READY  BEGIN  FINISHED  FAULT  STOPPED
PICTURE = """
INIT            SILENT    -           -      -         OVER      -
SILENT          -         ARMED       -      -         OVER      -
ARMED           -         -           ACTIVE -         STOPPING  -
ACTIVE          -         -           -      STOPPING  STOPPING  -
STOPPING        -         -           -      -         STOPPING  OVER
OVER            -         -           -      -         -         -
"""


@pytest.mark.parametrize("row", PICTURE.strip().splitlines())
def test_every_transition_is_the_one_in_the_picture(row: str) -> None:
    name, *targets = row.split()
    for event, target in zip(Event, targets, strict=True):
        if target == "-":
            with pytest.raises(ValueError, match="cannot happen"):
                next_state(RunState[name], event)
        else:
            assert next_state(RunState[name], event) is RunState[target]


def test_nothing_leaves_before_the_experiment_and_no_current_after_it() -> None:
    assert [s for s in RunState if may_send(s)] == [RunState.ACTIVE, RunState.STOPPING]
    assert [s for s in RunState if may_enable(s)] == [RunState.ACTIVE]


def test_every_fault_tells_cause_advice_and_exit_code() -> None:
    assert set(FAULTS) == set(Fault)
    for info in FAULTS.values():
        assert info.cause
        assert info.advice
        assert info.exit_code in (EXIT_SAFETY_STOP, EXIT_BUS)
