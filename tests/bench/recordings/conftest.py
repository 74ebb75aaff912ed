"""A recording of a machine that is no brake."""

from __future__ import annotations

import pytest

from tests.bench.linear_machine import MAP, Machine, record


@pytest.fixture(scope="package")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    """A recording in millimetres and kilonewtons, and its map, as arguments."""
    folder = tmp_path_factory.mktemp("others")
    found = record(Machine(), 2.0)
    rows = zip(found.time.tolist(), (1e3 * found.position).tolist(), (1e-3 * found.force).tolist(), strict=True)
    (folder / "r.csv").write_text("t,x,F\n" + "".join(f"{t!r},{x!r},{f!r}\n" for t, x, f in rows))
    text = (
        MAP.replace('"m"', '"m"\nscale = 1e-3')
        .replace('"N"', '"N"\nscale = 1e3')
        .replace("window = 0.5", "window = 0.1")
    )
    (folder / "map.toml").write_text(text)
    return str(folder / "r.csv"), "--map", str(folder / "map.toml")
