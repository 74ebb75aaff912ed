"""Plan of a run: what the command line asks for, checked as far as that is possible without a bus."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emb_runtime.can.messages import Layout
from emb_runtime.config.bench import Bench
from emb_runtime.control.start_conditions import Bounds, StartConditions
from emb_runtime.control.stop_condition import StopCondition
from emb_runtime.policy.policy import Policy
from emb_runtime.records import RunType
from emb_runtime.safety.shield_design import ShieldLaw

if TYPE_CHECKING:
    from emb_runtime.drives.mapping import Mapping


class Stage(StrEnum):
    """Stages in which a bench is taken into service: how much of the chain may act."""

    READ_ONLY = "read-only"
    ZERO = "zero"
    LIMITED = "limited"
    FULL = "full"


@dataclass(frozen=True)
class MappedDrive:
    """A drive with another DBC, behind the node."""

    mapping: Mapping
    bus: str  # Its bus, whose frames are recorded; "" in lock-step


@dataclass(frozen=True)
class Experiment:
    """An experiment: its policy, and when it ends."""

    policy: Policy
    law: ShieldLaw  # Of the shield; its steps are the samples of the experiment
    stop_condition: StopCondition | None  # Precision of the estimate at which it ends early
    home: bool  # The brake is brought to the origin before and after it


@dataclass(frozen=True)
class Precautions:
    """Precautions of this computer, and of the operator."""

    real_time: bool
    watchdog: bool
    confirm: bool | None  # Ask before anything is armed; None where the bus is real and there is somebody to ask


@dataclass(frozen=True)
class Output:
    """Output of a command: its log, its text, its pages."""

    log: Path  # As given by the user: a file, or a folder
    json: bool
    verbose: bool
    quiet: bool  # The verdict only
    live: int | None  # Port at which the run is shown
    open: bool  # A browser is started that shows it
    report: Path | None  # Page to write after the run


@dataclass(frozen=True)
class Label:
    """Origin of a run, for its log; empty texts where there is none."""

    typed: Sequence[str]  # Arguments as they were typed
    operator: str
    serial: str  # Serial number of the device


@dataclass(frozen=True)
class Plan:
    """Plan of a run."""

    iface: str
    bench: Bench
    layout: Layout
    drive: MappedDrive | None  # The node is its gateway
    stage: Stage
    limit: float  # Largest current that may leave [A]
    duration: float  # Of the experiment, or of the listening [s]
    experiment: Experiment | None  # None where the stage is to read only
    strict: bool  # An estimate outside the ranges is no success
    precautions: Precautions
    output: Output
    label: Label

    def start_conditions(self, *, anywhere: bool) -> StartConditions:
        """Conditions under which a run may begin; ``anywhere`` on the way home."""
        return StartConditions(self.bench, self.layout, Bounds(self.bench), anywhere=anywhere)

    def document(self, run_type: RunType, steps: int) -> dict[str, Any]:
        """One run of the plan, with its samples at most, as plain data: for the log's header and for ``--json``."""
        policy = self.experiment.policy if self.experiment and run_type is RunType.EXPERIMENT else None
        return {
            "purpose": str(run_type),
            "stage": str(self.stage),
            "limit": self.limit,
            "iface": self.iface,
            "steps": steps,
            "policy_kind": policy.contract.kind if policy else None,
            "policy_sha256": policy.sha256 if policy else None,
        }
