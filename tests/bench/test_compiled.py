from __future__ import annotations

import errno
import fcntl
import operator
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import prange
from numba.core.caching import IndexDataCacheFile

from emb_bench.brake import euler
from emb_bench.brake.euler import sensitivity_step, sign, step
from emb_bench.compiled import _fingerprint, compiled, on_compiling
from emb_bench.information.symmetric import Floats, add_increment, lambda_min, log_det, pack, trace_inverse
from emb_runtime.config.bench import BrakeParameters, load_bench

BENCH = load_bench()
T_S = 1e-3


sizes = st.floats(1e-6, 3.0)  # of matrix elements: squares and inverses are ordinary numbers


@settings(deadline=None)
@given(st.integers(1, 4), st.lists(st.one_of(st.just(0.0), sizes, sizes.map(operator.neg)), min_size=16, max_size=16))
def test_compiled_criteria_are_the_plain_ones_bit_for_bit(n: int, entries: list[float]) -> None:
    half = np.array(entries).reshape(4, 4)[:n, :n]
    m = pack(half @ half.T)
    work = np.empty((n, n))
    for criterion in (log_det, lambda_min, trace_inverse):
        assert compiled(criterion)(m, work) == criterion(m, work)


def batch(p: BrakeParameters, x1: Floats, x2: Floats, u: Floats, s: Floats, m: Floats, t_s: float) -> None:
    """A batch as training writes one: arrays outside, scalar functions inside."""
    for e in prange(x1.shape[0]):
        for k in range(u.shape[0]):
            for i in range(s.shape[1]):
                s[e, i, 0], s[e, i, 1] = sensitivity_step(p, x1[e], x2[e], u[k, e], t_s, s[e, i, 0], s[e, i, 1], i)
            x1[e], x2[e] = step(p, x1[e], x2[e], u[k, e], t_s)
            add_increment(m[e], s[e], 1e6, 1.0)


def test_a_compiled_batch_is_the_plain_one_bit_for_bit_on_one_core_and_on_all() -> None:
    """Through reversals and loss of contact."""
    u = np.random.default_rng(7).uniform(-3.0, 3.0, (60, 5)).repeat(4, axis=0)
    results = []
    for run in (batch, compiled(batch), compiled(batch, parallel=True)):
        x1, x2, s, m = np.zeros(5), np.zeros(5), np.zeros((5, 4, 2)), np.zeros((5, 10))
        run(BENCH.brake, x1, x2, u, s, m, T_S)
        results.append((x1, x2, s, m))
    for plain, fast, parallel in zip(*results, strict=True):
        np.testing.assert_array_equal(fast, plain)
        np.testing.assert_array_equal(parallel, plain)
    assert len(set(results[0][0].tolist())) == 5


def uses_a_module(value: float) -> float:
    return euler.sign(value)


def test_what_would_stay_python_or_be_compiled_again_for_each_object_is_refused() -> None:
    factor = 3.0

    def closure(value: float) -> float:
        return factor * sign(value)

    for function, why in ((uses_a_module, r"uses the module emb_bench\.brake\.euler: import"), (closure, "closure")):
        with pytest.raises(TypeError, match=why):
            compiled(function)


SCRIPT = """
import emb_bench.compiled as c
c.PACKAGES = (*c.PACKAGES, "callee", "constants")
from caller import caller
from emb_bench.compiled import compiled
fast = compiled(caller)
print(fast(10.0), sum(fast.stats.cache_hits.values()), sum(fast.stats.cache_misses.values()))
"""


@pytest.fixture
def in_a_new_process(tmp_path: Path) -> Callable[[Path], tuple[float, int, int]]:
    def run(cache: Path) -> tuple[float, int, int]:
        env = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT], env=env, capture_output=True, text=True, check=True, timeout=120
        )
        value, hits, misses = done.stdout.split()
        return float(value), int(hits), int(misses)

    write(tmp_path / "constants.py", "OFFSET = 1.0")
    write(tmp_path / "callee.py", "def callee(x):\n    return 2.0 * x")
    write(
        tmp_path / "caller.py",
        "from callee import callee\nfrom constants import OFFSET\ndef caller(x):\n    return callee(x) + OFFSET",
    )
    return run


def write(path: Path, text: str) -> None:
    path.write_text(text + "\n", encoding="utf-8")


@pytest.mark.slow
def test_machine_code_is_kept_on_disk_and_a_change_in_a_callee_or_constant_of_another_file_is_noticed(
    tmp_path: Path, in_a_new_process: Callable[[Path], tuple[float, int, int]]
) -> None:
    cache = tmp_path / "cache"
    assert in_a_new_process(cache) == (21.0, 0, 1)
    assert in_a_new_process(cache) == (21.0, 1, 0)
    write(tmp_path / "callee.py", "def callee(x):\n    return 3.0 * x")
    assert in_a_new_process(cache) == (31.0, 0, 1)
    write(tmp_path / "constants.py", "OFFSET = 2.0")
    assert in_a_new_process(cache) == (32.0, 0, 1)


def test_where_no_cache_can_be_written_functions_are_compiled_all_the_same(
    tmp_path: Path, in_a_new_process: Callable[[Path], tuple[float, int, int]]
) -> None:
    in_the_way = tmp_path / "a file"
    in_the_way.touch()
    assert in_a_new_process(in_the_way) == (21.0, 0, 1)


def test_what_nobody_used_for_a_month_leaves_the_cache_and_the_rest_stays(
    tmp_path: Path, in_a_new_process: Callable[[Path], tuple[float, int, int]]
) -> None:
    old, recent = (tmp_path / "cache/emb-excite/numba" / name for name in ("old", "recent"))
    for directory in (old, recent):
        directory.mkdir(parents=True)
    os.utime(old, (0, 0))
    in_a_new_process(tmp_path / "cache")
    assert not old.exists()
    assert recent.exists()


def test_where_numba_is_told_to_compile_nothing_the_plain_function_runs(tmp_path: Path) -> None:
    code = (
        "from emb_bench.brake.euler import sign; from emb_bench.compiled import compiled; print(compiled(sign)(-2.0))"
    )
    env = {**os.environ, "NUMBA_DISABLE_JIT": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=120)
    assert (done.stdout, done.stderr) == ("-1.0\n", "")


def kept(root: Path) -> bool:
    """True if the machine code of a function is on disk."""
    return next(root.glob("*/*/*.nbi"), None) is not None


def trebled(x: float) -> float:
    return 3.0 * x


machine_code = operator.neg  # Stands for a function of the compiled core


def calls_machine_code(x: float) -> float:
    return float(machine_code(x))


def test_a_function_of_the_compiled_core_is_kept_by_the_code_of_its_source(monkeypatch: pytest.MonkeyPatch) -> None:
    for source, result in ((trebled, 21.0), (halved, 3.5)):
        monkeypatch.setattr(
            "emb_bench.compiled._source_of", lambda value, source=source: source if value is machine_code else value
        )
        monkeypatch.setattr("emb_bench.compiled._done", {})
        _fingerprint.cache_clear()
        assert compiled(calls_machine_code)(7.0) == result
    _fingerprint.cache_clear()


def test_no_other_process_can_come_between_the_steps_in_which_machine_code_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """numba numbers a function's signatures in one file and keeps the code of each in another."""
    done = []

    def watched(name: str) -> Callable[..., Any]:
        step = getattr(IndexDataCacheFile, name)

        def shut(*arguments: Any) -> Any:
            (directory,) = tmp_path.iterdir()
            with (directory / "lock").open() as lock, pytest.raises(BlockingIOError):
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            done.append(name)
            return step(*arguments)

        return shut

    monkeypatch.setattr("emb_bench.compiled._cache_root", lambda: tmp_path)
    for name in ("load", "save"):
        monkeypatch.setattr(IndexDataCacheFile, name, watched(name))
    assert compiled(trebled)(3.0) == 9.0
    assert kept(tmp_path)
    assert done == ["load", "save"]


def halved(x: float) -> float:
    return 0.5 * x


def test_a_process_that_never_gives_the_lock_back_delays_and_stops_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("emb_bench.compiled.LOCK_WAIT", 0.0)
    monkeypatch.setattr("emb_bench.compiled._cache_root", lambda: tmp_path)
    fast = compiled(halved)
    (directory,) = tmp_path.iterdir()
    with (directory / "lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert fast(3.0) == 1.5
    assert not kept(tmp_path)


def tenfold(x: float) -> float:
    return 10.0 * x


def test_an_error_of_numba_s_own_files_is_told_as_numba_tells_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "no space")

    monkeypatch.setattr("emb_bench.compiled._cache_root", lambda: tmp_path)
    monkeypatch.setattr(IndexDataCacheFile, "save", full)
    with pytest.raises(OSError, match="no space"):
        compiled(tenfold)(1.0)


def test_machine_code_whose_types_are_no_more_is_dropped_and_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(*_: object) -> None:
        raise ModuleNotFoundError("emb_runtime.gone")

    monkeypatch.setattr("emb_bench.compiled._cache_root", lambda: tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(IndexDataCacheFile, "load", gone)
        assert compiled(twentyfold)(1.0) == 20.0
    assert kept(tmp_path)


def twentyfold(x: float) -> float:
    return 20.0 * x


def counted(x: float) -> float:
    return halved(x) + tenfold(x)


def test_a_command_can_show_how_many_functions_were_compiled_and_when_the_last_one_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("emb_bench.compiled._cache_root", lambda: tmp_path)
    monkeypatch.setattr("emb_bench.compiled._done", {})
    told: list[tuple[int, bool]] = []
    on_compiling(lambda count, last: told.append((count, last)))
    fast = compiled(counted)
    assert fast(2.0) == 21.0
    assert told == [(1, False), (2, False), (3, True)]
    assert fast(4.0) == 42.0
    assert len(told) == 3
