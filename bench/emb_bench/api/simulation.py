"""An experiment on the simulated bench."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any

from emb_bench.api.arguments import is_row, require_options
from emb_bench.api.runs import Run, delete_with, open_run
from emb_bench.config.bench import load_bench
from emb_bench.config.conditions import CONDITIONS
from emb_bench.config.plants import DEFAULT_PLANT
from emb_bench.experiment.experiment import planned
from emb_bench.sim.simulated_brake import NOISES, brake_of
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError, needs


def simulate(
    log: str | Path | None = None,
    *,
    plant: str = DEFAULT_PLANT,
    parameters: Mapping[str, float] | None = None,
    seed: int = 1,
    currents: Sequence[float] | Any | None = None,
    policy: str | Path | Any | None = None,
    quick: bool = False,
    bench: str | Path | None = None,
    duration: float | None = None,
    **more_parameters: float,
) -> Run:
    """Run one experiment on the simulated bench, behind the same shield and guard as on a real one.

    Args:
        log: MCAP file to write; must not exist (default: a temporary one, which is deleted with the run).
        plant: name of one of the bench's plants.
        parameters: true parameters by name; the others are nominal. So are ``angle_noise`` [rad] and
            ``velocity_noise`` [rad/s]; ``temperature`` [degC] with ``supply_voltage`` [V] are sent along.
        seed: of the sensors' noise.
        currents: requested in place of a policy, one per sample period [A].
        policy: ONNX file, or currents (default: the shipped actor).
        quick: the shipped actor for a short experiment, until the repeatability of all four parameters is about 1 %.
        bench: bench file (default: the shipped one).
        duration: of the experiment [s] (default: that of the currents, or the policy's horizon).
        more_parameters: true parameters as keywords: ``f_v=3e-5``.

    Returns:
        The run, opened; :attr:`~emb_bench.logs.log.RunLog.exit_reason` has its end.

    Raises:
        EmbError: an argument is wrong, the policy does not fit the bench, or the log cannot be written.
    """
    from emb_bench.sim.transport import open_brake
    from emb_runtime.cli.experiment import experiment
    from emb_runtime.cli.options import parser, prepare
    from emb_runtime.cli.session import Console

    if is_row(log):
        raise UsageError("log: expected a file to write, got currents: simulate(currents=...)")
    if currents is None and is_row(policy):
        currents, policy = policy, None
    if currents is not None and (policy is not None or quick):
        raise UsageError("currents: expected them without policy and without quick")
    require_options("simulate", more_parameters, (*PARAMETER_NAMES, *NOISES, *CONDITIONS, *_OPTIONS))
    brake = {"plant": plant, "seed": seed, **(parameters or {}), **more_parameters}
    temporary = Path(mkdtemp(prefix="emb-run-")) if log is None else None
    path = Path(log or f"{temporary}/run.mcap")
    try:
        with TemporaryDirectory() as folder:
            if currents is not None:
                policy, duration = _policy_of(currents, bench, Path(folder), duration)
            arguments = parser().parse_args([])
            arguments.iface = "sim:" + ",".join(f"{name}={value}" for name, value in brake.items())
            arguments.policy, arguments.bench = (None if name is None else Path(name) for name in (policy, bench))
            arguments.duration, arguments.quick, arguments.log = duration, quick, path
            given = {"policy": policy, "bench": bench, "duration": duration}
            arguments.typed = ["--iface", arguments.iface, "--log", str(path)]
            for name, value in given.items():
                arguments.typed += [] if value is None else [f"--{name}", str(value)]
            arguments.typed += ["--quick"] if quick else []
            plan = prepare(arguments)
            experiment(plan, path, Console(), open_brake(brake_of(brake, plan.bench, "sim: "), plan.bench))
        run = open_run(path)
    except BaseException:
        if temporary is not None:
            shutil.rmtree(temporary)
        raise
    if temporary is not None:
        delete_with(run, temporary)
    return run


_OPTIONS = tuple(simulate.__kwdefaults__ or ())
"""Names of the keywords of :func:`simulate`."""


def _policy_of(currents: Any, bench: str | Path | None, folder: Path, duration: float | None) -> tuple[Path, float]:
    """A policy file that requests currents [A], and how long they last [s]."""
    its, row = load_bench(bench), planned(currents).currents
    if not 1 <= len(row) <= its.timing.horizon:
        raise UsageError(f"expected 1 to {its.timing.horizon} currents, as the bench file's horizon, got {len(row)}")
    with needs("a run with own currents", "bench"):
        from emb_bench.export.policy_file import sequence_file
    path = folder / "currents.onnx"
    path.write_bytes(sequence_file(row, "own currents", its))
    return path, len(row) * its.timing.sample_time if duration is None else duration
