"""An experiment on the simulated bench."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from emb_bench.api.runs import Run, open_run
from emb_bench.config.plants import DEFAULT_PLANT


def simulate(
    log: str | Path,
    *,
    plant: str = DEFAULT_PLANT,
    parameters: Mapping[str, float] | None = None,
    seed: int = 1,
    policy: str | Path | None = None,
    quick: bool = False,
    bench: str | Path | None = None,
    duration: float | None = None,
) -> Run:
    """Run one experiment on the simulated bench, behind the same shield and guard as on a real one.

    Args:
        log: MCAP file to write; must not exist.
        plant: name of one of the bench's plants.
        parameters: true parameters by name; the others are nominal.
        seed: of the sensors' noise.
        policy: ONNX file (default: the shipped actor).
        quick: the shipped actor for a short experiment, until all four parameters are known to about 1 %.
        bench: bench file (default: the shipped one).
        duration: of the experiment [s] (default: the policy's horizon).

    Returns:
        The run, opened; :attr:`~emb_bench.logs.log.RunLog.exit_reason` says how it ended.

    Raises:
        EmbError: an argument is wrong, the policy does not fit the bench, or the log cannot be written.
    """
    from emb_runtime.cli.experiment import experiment
    from emb_runtime.cli.options import parser, prepare
    from emb_runtime.cli.session import Console

    options = {"plant": plant, "seed": seed, **(parameters or {})}
    iface = "sim:" + ",".join(f"{name}={value}" for name, value in options.items())
    arguments = ["--iface", iface, "--log", str(log)]
    for option, value in (("--policy", policy), ("--bench", bench), ("--duration", duration)):
        if value is not None:
            arguments += [option, str(value)]
    if quick:
        arguments.append("--quick")
    plan = prepare(parser().parse_args(arguments))
    experiment(plan, Path(log), Console())
    return open_run(log)
