"""What an examiner of logs makes of a drive whose signals have coarse steps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from emb_bench.commission.drive_steps import acted, mapping_of, noise_in_motion, scatter
from emb_bench.experiment.experiment import read_experiment
from emb_bench.experiment.info import Floats
from emb_bench.logs.log import read_log
from emb_bench.sim import drives
from emb_bench.sim.drives import Vesc
from emb_runtime.cli.main import main
from emb_runtime.config.bench import Noise, parse_bench
from emb_runtime.drives.mapping_file import load_mapping
from emb_runtime.records import Frame
from tests.actors import constant_actor
from tests.drives import EXAMPLES
from tests.runtime.drives.mapped import late_bench


@pytest.mark.parametrize(
    ("sigma", "centre"), [(0.3, 0.0), (0.5, 0.0), (0.5, 0.5), (0.8, 0.25), (1.5, 0.5), (1.5, 0.0), (50.0, 0.0)]
)
def test_noise_of_less_than_a_step_is_found_wherever_the_brake_rests(sigma: float, centre: float) -> None:
    step, drawn = 3.4e-3, np.random.default_rng(4).normal(centre, sigma, 4000)
    for between in (0.0, 0.5):  # zero is one of the values, or lies between two
        assert scatter(step * (np.round(drawn) + between), step) == pytest.approx(sigma * step, rel=0.1)


def test_a_brake_that_shows_one_value_has_little_noise() -> None:
    assert scatter(np.full(500, 1.7e-3), 3.4e-3) < 1e-3


def test_a_signal_without_steps_scatters_as_its_samples_do() -> None:
    drawn = np.random.default_rng(4).normal(0.0, 1e-3, 500)
    assert scatter(drawn, 0.0) == pytest.approx(np.std(drawn, ddof=1), rel=1e-12)


def test_what_acted_is_the_command_where_the_drive_tells_its_current_in_steps_of_a_tenth_of_an_ampere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Commands act a sample late, so that the node tells another one."""
    truly: list[float] = []

    class Watched(Vesc):
        def broadcast(self) -> list[Frame]:
            truly.append(self.applied)
            return super().broadcast()

    monkeypatch.setattr(drives, "DRIVES", {"vesc": Watched})
    monkeypatch.setattr("signal.signal", lambda *_: None)
    bench, actor, log = (tmp_path / name for name in ("late.toml", "actor.onnx", "run.mcap"))
    bench.write_text(late_bench())
    actor.write_bytes(constant_actor(parse_bench(late_bench(), "late.toml"), 2.0))
    iface = f"map:{EXAMPLES / 'vesc.toml'}@sim-drive:vesc,plant=late-command"
    files = ["--bench", str(bench), "--policy", str(actor), "--log", str(log)]
    assert main(["--iface", iface, "--serial", "x", *files]) == 0

    opened = read_log(log)
    mapping, told = mapping_of(opened), read_experiment(opened)
    assert mapping is not None
    found = acted(opened, mapping, told, late=1)

    def error(currents: Floats) -> float:
        """Largest, of the periods after the first command, from where in the drive's own account they begin best."""
        n = told.periods
        return min(
            float(np.max(np.abs(currents[2:] - truly[begin + 2 : begin + n]))) for begin in range(len(truly) - n + 1)
        )

    assert error(told.currents) > 0.05
    assert error(found) < 1e-3


def test_steps_add_to_the_noise_of_a_brake_that_moves_and_our_own_node_has_none_to_speak_of() -> None:
    at_rest = Noise(8e-4, 0.6)
    moving = noise_in_motion(at_rest, load_mapping(EXAMPLES / "mit.toml"))
    turned = np.random.default_rng(4).uniform(0.0, 10.0, 20_000)
    step = 9 * 25.0 / 65535  # a gear of 9; the protocol's 16 bits from -12.5 to 12.5 rad
    shown = step * np.floor((turned + np.random.default_rng(5).normal(0.0, 8e-4, turned.shape)) / step)
    assert moving.angle == pytest.approx(np.std(shown - turned), rel=0.03)
    assert noise_in_motion(at_rest, None) == at_rest
