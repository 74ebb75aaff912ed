"""A policy file from outside is tried by a confined process, which can be ended at any moment."""

from __future__ import annotations

import os
import time
from functools import partial
from pathlib import Path

import pytest

from emb_runtime.config.bench import load_bench
from emb_runtime.errors import PolicyRefusedError, UsageError
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.policy import trial
from emb_runtime.policy.contract import MAX_VECTORS, Vector
from emb_runtime.policy.policy import shipped_actor_path
from emb_runtime.policy.trial import admit_policy
from emb_runtime.system.child_process import Child
from tests.actors import constant_actor
from tests.runtime.operating import refusal
from tests.runtime.policy.test_policy import model_of

BENCH = load_bench()


def children() -> set[str]:
    return set(Path(f"/proc/self/task/{os.getpid()}/children").read_text().split())


def test_an_honest_actor_is_admitted_and_no_process_is_left() -> None:
    before = children()
    path, estimator = shipped_actor_path(), Estimator(BENCH)
    from_file, from_bytes = admit_policy(path, BENCH), admit_policy(path.read_bytes(), BENCH)
    assert from_file.act(0.0, 0.0, 0, estimator) == from_bytes.act(0.0, 0.0, 0, estimator) != 0.0
    assert children() == before


def test_the_reason_of_a_refusal_is_the_one_that_the_process_found() -> None:
    before = children()
    assert "has no graph" in refusal(lambda: admit_policy(b"", BENCH))
    assert "test vector 0" in refusal(
        lambda: admit_policy(constant_actor(BENCH, 2.0).replace(b'"outputs":[2.0]', b'"outputs":[1.0]'), BENCH)
    )
    assert children() == before


def tried_with(folder: Path, monkeypatch: pytest.MonkeyPatch, load_policy: str, before: str = "pass") -> None:
    """Have policies tried by a process with another ``load_policy``, given as code, in the place of ONNX Runtime."""
    (folder / "tried.py").write_text(
        f"{before}\nimport sys\nfrom emb_runtime.policy import trial\nfrom_file = trial.load_policy\n"
        f"def load_policy(*arguments):\n    {load_policy}\n"
        "trial.load_policy = load_policy\nsys.exit(trial.main(sys.argv[1:]))\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(folder))
    monkeypatch.setattr(trial, "PROGRAM", "tried")


def test_whatever_happens_to_the_process_is_a_refusal_of_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trial, "MULTIPLE", 1.0)
    monkeypatch.setattr(trial, "LEAST", 0.0)
    before = children()
    for code, said in (
        ("while True: pass", "of processor time"),
        ("raise MemoryError", "takes more than 256 MiB of memory"),
        ("bytearray(1 << 30)", "takes more than 256 MiB of memory"),
        ("import ctypes; ctypes.string_at(0)", r"could not be tried: the trial process died \(signal 11\)"),
        ("import os; os._exit(0)", r"could not be tried: the trial process died \(exit status 0\)"),
        ("import os; os.write(1, b'x' * (1 << 21))", "could not be tried: the trial process wrote more than"),
    ):
        tried_with(tmp_path, monkeypatch, code)
        with pytest.raises(PolicyRefusedError, match=said) as refused:
            admit_policy(b"", BENCH)
        assert "\n" not in str(refused.value)
        assert children() == before


SLOW = """
import time
def slowed(began, factor=5.0):
    while time.process_time() - began < factor * (used - began):
        pass
import onnxruntime, emb_runtime.policy.policy
used = time.process_time()
slowed(0.0)
"""
"""A computer five times as slow: everything takes five times the processor time, the start of the process included."""


def test_an_honest_actor_is_admitted_on_a_computer_that_is_five_times_as_slow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loading = "global used; began = time.process_time(); said = from_file(*arguments); used = time.process_time()"
    tried_with(tmp_path, monkeypatch, f"{loading}; slowed(began); return said", SLOW)
    admit_policy(shipped_actor_path(), BENCH)


UNCOUNTED = """
import resource, time, types
time.process_time = lambda: 0.0
resource.getrusage = lambda who: types.SimpleNamespace(ru_utime=0.0, ru_stime=0.0)
"""
"""A kernel that has given the time of this process to others: one in a virtual machine, which counts in ticks, did."""


def test_an_honest_actor_is_admitted_where_the_kernel_has_counted_no_processor_time_yet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried_with(tmp_path, monkeypatch, "return from_file(*arguments)", UNCOUNTED)
    admit_policy(shipped_actor_path(), BENCH)


def test_a_file_that_makes_onnx_runtime_work_for_long_or_take_memory_is_refused_in_bounded_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(trial, "MULTIPLE", 2.0)
    monkeypatch.setattr(trial, "LEAST", 0.0)
    products = " ".join(f"p{n + 1} = MatMul(p{n}, p{n})" for n in range(100))  # 2e11 sums in one evaluation
    rows = (
        ("p0 = Expand(zero, side) " + products + " b = ReduceMax<keepdims=1>(p100)", "{1000, 1000}", "processor time"),
        ("p0 = Expand(zero, side) b = ReduceMax<keepdims=1>(p0)", "{1000000, 1000000}", ""),
        ("p0 = Expand(zero, side) p1 = Reshape(p0, side) b = ReduceMax<keepdims=1>(p1)", "{10000, 10000}", ""),
    )
    for body, side, said in rows:
        weights = f"int64[2] side = {side}, float[3,1] w = {{0., 0., 0.}}"
        head = f"agent (float[1,3] inputs) => (float[1,1] outputs) <{weights}>"
        vectors = (Vector((0.0, 0.0, 0.0), (0.0,)),) * MAX_VECTORS  # all are reproduced, if there is time
        data = model_of(f"{head} {{ zero = MatMul(inputs, w) {body} outputs = Identity(b) }}", vectors=vectors)
        began = time.monotonic()
        refused = refusal(partial(admit_policy, data, BENCH))
        assert said in refused
        assert time.monotonic() - began < 120.0  # of a busy computer


def test_a_process_that_cannot_be_started_is_no_fault_of_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "PROGRAM", "no.such.module")
    with pytest.raises(UsageError, match="cannot try the policy"):
        admit_policy(b"", BENCH)

    def full(*_: object) -> Child:
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(trial, "Child", full)
    with pytest.raises(UsageError, match=r"cannot try the policy: .*Resource temporarily"):
        admit_policy(b"", BENCH)
