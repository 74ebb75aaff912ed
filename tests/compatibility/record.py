"""Record the golden logs anew, with the shipped actor.

    python -m tests.compatibility.record

What they hold is said in ``test_golden_logs.py``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from unittest.mock import patch

from emb_bench.config.bench import Bench
from emb_bench.sim.transport import SimTransport, SteppedClock, open_sim
from emb_runtime.can.messages import load_layout
from emb_runtime.cli.main import main as emb_run
from emb_runtime.records import Frame

FOLDER = Path(__file__).parent / "golden"
FIRST_WRONG = 420  # Angle frame
WRONG = 5.0  # [rad]


def with_wrong_angles(options: str, bench: Bench) -> tuple[SimTransport, SteppedClock]:
    """A simulated bus on which every other angle is wrong from one on."""
    opened, clock = open_sim(options, bench)
    layout, receive, seen = load_layout(), opened.receive, 0

    def received(deadline_ns: int) -> Frame | None:
        nonlocal seen
        frame = receive(deadline_ns)
        if frame is None or frame.identifier != layout.angle.identifier:
            return frame
        seen += 1
        if seen < FIRST_WRONG or seen % 2:
            return frame
        true = layout.decode_angle(frame)
        wrong = layout.encode_angle(true.counter, true.angle + WRONG, true.device_time_ns)
        return wrong._replace(time_ns=frame.time_ns)

    opened.receive = received  # type: ignore[method-assign]
    return opened, clock


def main() -> None:
    """Record both."""
    arguments = ["--iface", "sim:plant=exact,seed=3", "--duration", "0.25", "-q", "--log"]
    sys.argv[0] = "emb-run"
    for name, bus in (("done", open_sim), ("rejected", with_wrong_angles)):
        log = FOLDER / f"{name}.mcap"
        log.unlink(missing_ok=True)
        with patch("emb_bench.sim.transport.open_sim", bus):
            emb_run([*arguments, str(log)])


if __name__ == "__main__":
    main()
