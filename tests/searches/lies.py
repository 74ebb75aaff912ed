"""Lies of a node: what becomes of an experiment, and where the true brake has been.

    python -m tests.searches.lies [--quick] [KIND ...]

A table: kind and size of a lie, result and exit code, periods until the stop, the largest true angles and speed until
the brake rests. The shipped actor drives; the node is that of the tests, with a codec and a brake of its own. To see
what an older version made of the same lies, run this file with that version's Python.
"""

from __future__ import annotations

import argparse
import sys

from emb_runtime.config.bench import load_bench
from emb_runtime.control.stop_condition import parse_stop_condition
from emb_runtime.estimator.estimator import estimated
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_runtime.safety.state_machine import FAULTS
from tests.lying.node import HONEST, Lie
from tests.scenarios.lies import run

BENCH = load_bench()
SEEN: dict[str, tuple[Lie, ...]] = {
    "angle drifts [rad/s]": tuple(Lie(drift=r, begin=0.15) for r in (30.0, 45.0)),
    "velocity off [rad/s]": (Lie(offset=40.0, begin=0.15),),
    "both a third": (Lie(scale=0.33, begin=0.0),),
    "wrong polarity": (Lie(motor=-1, begin=0.0), Lie(sensors=-1, begin=0.0)),
    "clock jumps [s]": (Lie(clock_jump=0.5, begin=0.15), Lie(clock_jump=0.013, clock_jump_angle=-5.0, begin=0.15)),
    "clock times": (Lie(clock=1.01, begin=0.0), Lie(clock=0.95, begin=0.0)),
    "every other sample": (Lie(jump=5.0, duty=0.5, begin=0.15), Lie(crc=True, duty=0.5, begin=0.15)),
    "not obeyed": tuple(Lie(deaf=True, duty=d, begin=0.15) for d in (0.5, 0.3)),
    "brakes with 20 A": (Lie(current=20.0, duty=0.5, begin=0.15),),
    "not what it was": (Lie(idle=True, duty=0.1, begin=0.15), Lie(identity=1, begin=0.15)),
}
"""Lies that single samples show: the table of docs/reference/fault-codes.md."""
KNOWN: dict[str, tuple[Lie, ...]] = {
    "honest": (HONEST, Lie(lost=0.02), Lie(lost=0.05)),
    "sliding scale [1/s]": tuple(Lie(slide=r, blind=True, begin=0.0) for r in (1.0, 0.5, 0.2, -0.5, -1.0)),
    "wrong zero [rad]": tuple(Lie(zero=z, blind=True) for z in (5.0, -5.0, 20.0, 10.0, 2.0, -2.0)),
    "both drift [rad/s]": tuple(Lie(both=r, blind=True) for r in (5.0, -5.0, 2.5, 10.0, -10.0)),
    "current times": tuple(Lie(gain=g) for g in (1.5, 1.2, 0.8, 0.5, 1.05)),
    "current grows [1/s]": tuple(Lie(gain_rate=r) for r in (1.0, 0.5, 0.2, -0.5, -1.0)),
    "reported current off [A]": tuple(Lie(reported=a, begin=0.0) for a in (0.4, 0.2, -0.4, 0.1)),
    "both drift, losses [rad/s]": tuple(Lie(both=r, blind=True, lost=0.05) for r in (5.0, -5.0, 10.0)),
    "angle drifts, losses [rad/s]": tuple(Lie(drift=r, lost=0.05) for r in (2.0, 5.0, -5.0)),
}
NEW: dict[str, tuple[Lie, ...]] = {
    "scale swings": tuple(Lie(wave=a, blind=True, begin=0.0) for a in (0.3, 0.1, 0.05)),
    "scale jumps to": tuple(Lie(step=f, blind=True, begin=0.2) for f in (0.5, 0.8, 0.9, 1.1, 1.3)),
    "angle curved [1/rad]": tuple(Lie(curve=c, blind=True, begin=0.0) for c in (0.001, 0.003, -0.003)),
    "current swings": tuple(Lie(gain_wave=a, begin=0.0) for a in (0.3, 0.1)),
    "current off, unreported [A]": tuple(Lie(offset_current=a, begin=0.0) for a in (0.4, -0.4, 0.2)),
    "dead band of the drive [A]": tuple(Lie(dead=a, begin=0.0) for a in (0.2, 0.5, 1.0)),
    "friction grows [1/s]": tuple(Lie(friction_rate=r, begin=0.0) for r in (1.0, 3.0, -1.0)),
    "a model for the encoder, k_m times": tuple(Lie(imagined=k, blind=True) for k in (0.6, 0.75, 1.3)),
    "stiffness changes to": tuple(Lie(stiffness=k, begin=0.25) for k in (0.5, 0.8, 1.3)),
}
"""Kinds that were not among those found by the first attack."""
UNDETECTED = 10  # Named in docs/explanation/sensor-monitor.md


def size_of(lie: Lie) -> str:
    """Part of it that is not honest, in words."""
    told = {name: value for name, value in vars(lie).items() if repr(value) != repr(getattr(HONEST, name))}
    return ", ".join(f"{name} {value:g}" for name, value in told.items() if name != "blind") or "-"


def main() -> int:
    """Print the table; 1 if more lies are called done than the page names, one of SEEN, or an honest run is not."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--quick", action="store_true", help="the actor and the stop condition of emb-run --quick")
    p.add_argument("kinds", nargs="*", help="some of the kinds; all without")
    arguments = p.parse_args()
    policy = load_policy(shipped_actor_path(arguments.quick), BENCH)
    goal = ",".join(f"{name}=1.2%" for name in estimated(BENCH)) if arguments.quick else ""
    condition = parse_stop_condition(goal, estimated(BENCH)) if goal else None
    print(
        "| kind | lie | result | exit | stopped after [ms] | unexplained [rad/s] | true angle [rad] | speed [rad/s] |"
    )
    print("|---|---|---|---|---|---|---|---|", flush=True)
    total = done = wrong = 0
    for kind, lies in {**SEEN, **KNOWN, **NEW}.items():
        for lie in lies if not arguments.kinds or kind in arguments.kinds else ():
            seen = run(lie, actor=policy, stop_condition=condition)
            node, fault = seen.node, seen.outcome.fault
            for _ in range(400):  # until it rests
                node.tick()
            result, code = ("done", 0) if fault is None else (fault.name, FAULTS[fault].exit_code)
            print(
                f"| {kind} | {size_of(lie)} | {result} | {code} | {'-' if seen.detected is None else seen.detected} | "
                f"{seen.outcome.unexplained[0]:.1f} | {node.lowest:.1f} .. {node.highest:.1f} | {node.fastest:.0f} |",
                flush=True,
            )
            if kind == "honest":
                wrong += result != "done"
            elif kind in SEEN:
                wrong += result == "done"
            else:
                total, done = total + 1, done + (result == "done")
    print(f"| {total} lies of a node: called done | – | {done} |")
    return 1 if wrong or done > UNDETECTED else 0


if __name__ == "__main__":
    sys.exit(main())
