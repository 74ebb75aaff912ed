"""The compiled core gives the bits of its sources, function by function. ``--inputs N`` draws N for each."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from tests.compiled.functions import BLOCK, FUNCTIONS, answers, is_compiled

pytestmark = pytest.mark.compiled


@pytest.fixture(scope="module")
def cores() -> Iterator[tuple[ProcessPoolExecutor, ProcessPoolExecutor]]:
    """A process that runs the compiled core, and one that runs its sources."""
    with pytest.MonkeyPatch.context() as patch:
        pools = []
        for choice in ("compiled", "python"):
            patch.setitem(os.environ, "EMB_CORE", choice)  # of the process that is started now
            pools.append(ProcessPoolExecutor(1, get_context("spawn")))
            found = pools[-1].submit(is_compiled).result()  # started now; BrokenProcessPool where there is no such core
            assert found is (choice == "compiled")
    compiled, plain = pools
    with compiled, plain:
        yield compiled, plain


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_gives_the_same_bits_compiled(
    name: str, cores: tuple[ProcessPoolExecutor, ProcessPoolExecutor], request: pytest.FixtureRequest
) -> None:
    for seed in range(-(-request.config.getoption("--inputs") // BLOCK)):
        compiled, plain = (found.result() for found in [core.submit(answers, name, seed) for core in cores])
        differing = [(n, a[:80], b[:80]) for n, (a, b) in enumerate(zip(compiled, plain, strict=True)) if a != b]
        assert differing == [], f"{name}, seed {seed}: {len(differing)} of {BLOCK} differ"
