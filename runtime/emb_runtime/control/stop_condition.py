"""Early-stop condition on the precision of the estimate: ``--stop-when``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError, near
from emb_runtime.estimator.estimate import NORMAL_95
from emb_runtime.numbers import in_percent

COUNT = len(PARAMETER_NAMES)  # Number of values of an estimate; their deviations follow
REACHED = "KNOWN_ENOUGH"  # Code of its event in the log


@dataclass(frozen=True)
class StopCondition:
    """Upper bounds on the repeatabilities, each relative to its value, at which an experiment ends."""

    text: str  # Text as :func:`parse_stop_condition` reads it
    parts: tuple[tuple[int, float], ...]  # Indices of parameters, and the bound of each repeatability; 0.01 is 1 %

    def reached(self, estimate: Sequence[float]) -> bool:
        """Returns True if all repeatabilities are below their bounds; one of zero, an error, is not."""
        return all(0.0 < NORMAL_95 * estimate[COUNT + at] < part * abs(estimate[at]) for at, part in self.parts)

    def describe(self, estimate: Sequence[float]) -> str:
        """Text with the repeatabilities and their bounds, for a condition that is met."""
        shares = ((at, NORMAL_95 * estimate[COUNT + at] / abs(estimate[at]), part) for at, part in self.parts)
        return "repeatability " + ", ".join(
            f"{PARAMETER_NAMES[at]} ± {in_percent(share)} of {in_percent(part, 3)}" for at, share, part in shares
        )


def parse_stop_condition(text: str, names: Sequence[str]) -> StopCondition:
    """Read a stop condition such as ``k_1=1%,f_v=5%`` on the parameters that are estimated."""
    if not names:
        raise UsageError("--stop-when: the bench's [estimator] estimates no parameter: leave the option out")
    parts: dict[int, float] = {}
    for item in text.split(","):
        name, _, percent = item.partition("=")
        if (name := name.strip()) not in names:
            expected = f"--stop-when: expected one of {', '.join(names)}, which are estimated"
            raise UsageError(f"{expected}, got '{name}'{near(name, names)}")
        if PARAMETER_NAMES.index(name) in parts:
            raise UsageError(f"--stop-when: {name} is named twice")
        parts[PARAMETER_NAMES.index(name)] = _part(name, percent.strip())
    return StopCondition(text, tuple(parts.items()))


def _part(name: str, percent: str) -> float:
    try:
        part = float(percent.removesuffix("%")) / 100.0 if percent.endswith("%") else -1.0
    except ValueError:
        part = -1.0
    if not 0.0 < part <= 1.0:
        raise UsageError(
            f"--stop-when: {name}: expected a percentage above 0 % up to 100 %, as in {name}=1%, got '{percent}'"
        )
    return part
