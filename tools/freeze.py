"""Freeze what the commands compute, and compare: the ruler by which the cuts of version 0.3 are judged. Goes with 0.3.

    python -m tools.freeze                      write tests/freeze/*.json
    python -m tools.freeze --check              compare with them, print each difference, exit 1 if there is one
    python -m tools.freeze --check --only fim   one section; may be given more than once
    python -m tools.freeze --python ../old/.venv/bin/python ...     measure another checkout
    python -m tools.freeze --times ../old/.venv/bin/python          its times and memory over those of this one

Logs are made anew by the commands measured, with fixed seeds: a simulation is the same to the last bit. The section
``logs`` says whether they are; if one is not, what is computed from it may differ for that reason alone. ``--keep DIR``
leaves the logs in DIR, ``--logs DIR`` reads those there in place of new ones, which tells readers and estimators from
simulation.

Numbers are compared within the tolerances of TOLERANCES; booleans, null, exit codes and words without a space exactly.
Sentences are kept but compared with ``--words`` only, as are keys that are new: they lose nothing.
"""

from __future__ import annotations

import argparse
import contextlib
import fnmatch
import hashlib
import json
import math
import os
import re
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeGuard

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "tests" / "freeze"

# ---- what 0.3 calls otherwise ------------------------------------------------------------------------------------

COMMANDS = {
    "run": ["emb-run"],
    "fim": ["emb-replay", "fim"],
    "estimate": ["emb-replay", "estimate"],
    "report": ["emb-replay", "report"],
    "campaign": ["emb-replay", "campaign"],
    "info": ["emb-replay", "info"],
    "timing": ["emb-replay", "timing"],
    "rerun": ["emb-replay", "rerun"],
    "design": ["emb-design"],
    "export": ["emb-export"],
    "train": ["emb-train"],
}
"""Console scripts. One that is renamed is renamed here; the frozen data stay."""
CYCLES, FRAMES = "/cycle", ["/can/rx", "/can/tx"]
"""Topics of a log."""
RENAMED: dict[str, dict[str, str]] = {
    "estimate": {"together": "suspects_together"},
}
"""Keys of JSON documents by section: the new name, and the frozen one."""
NAMED = "an estimate has its repeatability and its total"
GONE: dict[str, str] = {
    "logs/emps*": "a recording of others is read by fim, estimate and report: no log is made of it",
    "estimate/emps windows/says/records/emps.mcap": "a record has the name of its file, which is the recording's own",
    "info/emps*": "a recording of others is no log",
    "timing/emps*": "a recording of others is no log",
    "rerun/emps*": "a recording of others is no log",
    "estimate/*/held_out*": "each of several records is predicted from the others; no other is",
    "report/*/held_out*": "each of several records is predicted from the others; no other is",
    "design/*/coarse_optima*": "of a search the designs that keep the limits are told, not where each began",
    "design/*/of": "a design is for all of its parameters",
    "estimate/*/bounds*": "the range of a search is a tenth of nominal to ten times it",
    "report/*/bounds*": "the range of a search is a tenth of nominal to ten times it",
    "estimate/*/growth*": "estimate --grow is no more: score tests name the missing effect, --model all compares",
    "campaign/*/rms_error_sigmas": "the rows have the error of each run",
    "campaign/*/covered": "the rows have the error of each run",
    "campaign/*/spread*": "the test of homogeneity has the scatter of the runs",
    "estimate/*/why_not": "the reasons are codes, in doubts",
    "report/*/why_not": "the reasons are codes, in doubts",
    "fim/*/why_not": "the reasons are codes, in doubts",
    "estimate/*/arbitrary": "no value is excluded where the interval is open at both ends",
    "estimate/*/traded_with/*": "named where the deviation is above 1 %, as in the text; correlation has all",
    "estimate/*/profiles/*/shape": "an open profile is a doubt",
    "report/*/profiles/*/shape": "an open profile is a doubt",
    "info/*/says/estimate/*/interval_95*": NAMED,
    "runs/*/says/estimate/*/interval_95*": NAMED,
    "logs/*/says/estimate/*/interval_95*": NAMED,
    "estimate/*/says/misfit/suspected/*": "no effect is suspected in an amount that no brake can have",
    "info/*/says/messages//log": "an internal error's place is in its event's detail",
}
"""Patterns of frozen paths, ``section/name/key/...``, that are no more, and why."""
JOINED = "one note says that the residuals of both signals are correlated in time"
STAMPED = "what a lock-step gateway sends has its time, and its frames count"
OTHER_SEARCH = "the search of designs has no growth of tables: other local optima; E of four became better by a third"
GRID = "the grid of a profile has its steps in the logarithm: other points of the same curve"
MAPPED = "a map states the course of a command: what another one moves is no part of an interval"
LOGARITHM = "what windows of another length, or a flat prior, change is that of the logarithm"
WINDOWS = (
    "searched from eight points some windows have better starts, and chi2 is lower by 4e-6; with starts that settle "
    "from the samples the information at the frozen values is the frozen one"
)
METRES = "a linear machine is stated in metres and newtons, not in radians of a motor"
EXPLAINED: dict[str, str] = {
    "fim/*/findings/*/border": "a code, null where there is none",
    "*/says/profiles/*/values*": GRID,
    "*/says/profiles/*/rise*": GRID,
    "*/says/estimate/profiles/*/values*": GRID,
    "*/says/estimate/profiles/*/rise*": GRID,
    "estimate/clean windows/says/parameters/*/sandwich": LOGARITHM,
    "estimate/emps windows/says/parameters/*/interval_95*": MAPPED,
    "estimate/emps windows/says/parameters/*/deviation*": MAPPED,
    "estimate/emps windows/says/parameters/*/sandwich": MAPPED,
    "estimate/clean pem/says/information/0/0": LOGARITHM,
    "estimate/several oem/says/misfit/suspects/contact/*": "0.06 of a thousandth of it is beside the logs' own offsets",
    "estimate/*/says/misfit/notes": JOINED,
    "estimate/*/says/misfit/alarms": JOINED,
    "demo/*/numbers*": "one format of numbers, and kB of the log: /clock has no drift_ns",
    "estimate/disturbed pem/says/parameters/*/interval_95/0": "an interval ends at the least value that is possible",
    "runs/quick/*": "it ends at a repeatability of 1.2 %, a sample earlier than at deviations of 0.6 %",
    "design/*/says/local_optima/*": OTHER_SEARCH,
    "design/*/says/checks/*": OTHER_SEARCH,
    "design/E of four/says/*": OTHER_SEARCH,
    "fim/emps/says/physical/matrix/3/*": METRES,
    "fim/emps/says/physical/matrix/[012]/3": METRES,
    "fim/emps/says/physical/cramer_rao/current_offset": METRES,
    "fim/emps/says/physical/findings/current_offset/deviation": METRES,
    "fim/emps/says/fit_sigmas/velocity": "an observer derives it: it is no measurement to compare with",
    "estimate/disturbed pem/says/misfit/suspected/velocity_lag": "the velocity itself shows no observer",
    "fim/emps/says/weighted/*": "the outputs are divided by a brake's 100 and 500, which are of metres now",
    "report/emps/says/runs/0/experiment/*": METRES,
    "estimate/emps windows/says/information/3/3": METRES,
    "estimate/emps windows/says/parameters/*/repeatability": WINDOWS,
    "estimate/emps windows/says/parameters/*/cramer_rao": WINDOWS,
    "estimate/emps windows/says/correlation/matrix/*": WINDOWS,
    "estimate/emps windows/says/misfit/suspects/break_away/*": "acts at rest only: a secant, of the sign that none has",
    "estimate/emps windows/says/misfit/suspects_together/statistic": "that secant is among them",
    "logs/mapped/*": STAMPED,
    "info/mapped/says/messages//*": STAMPED,
    "info/mapped/says/duration": "the arming of a lock-step drive takes one sample more",
}
"""The same, of values that differ on purpose."""

# ---- what is kept of a document ----------------------------------------------------------------------------------

LEFT_OUT = (
    "log path root campaign page result_file made_by version bench_sha256 sha256 identity_hash bench_hash "
    "policy_sha256 policy_provenance command tool core python numpy onnxruntime kernel began start_time time_of_day "
    "log_bytes wall_time evaluated_by other_versions policy_evaluated_by emb.preflight preflight starts attachments "
    "bytes file number realtime disk conclusions theta advice "
    "caveats words unit p_value trend iface"
)
"""Keys that say when, where and by which version, and those that repeat others."""
REPORTED = ("model_fits", "predicts", "identified", "profiles")
"""Of the estimate in a report; the rest is that of the section ``estimate``."""
UNREPORTED = ("info", "timing")
"""Of a run in a report: sections of their own."""
LONG, KEPT = 24, 5
"""A list of more numbers is kept as its length and so many of its numbers."""
DIGITS, PRECISE = {"estimate": 6, "report": 6, "fim": 8}, 10
"""Digits that are kept: of a section, else, and of values and their intervals, PRECISE."""
TIMES_OF_DAY = 10**17
"""Whole numbers from here on are times [ns] and left out."""
NAMES = ("name", "label", "plant")
"""Keys that tell the members of a list apart: their order is not compared."""


class Tolerance(NamedTuple):
    """Largest distance of a number from the frozen one."""

    relative: float
    """Of the largest number in the same list."""
    absolute: float


EXACT = Tolerance(1e-9, 1e-12)
TOLERANCES = {
    "logs": EXACT,
    "runs": EXACT,
    "can": EXACT,
    "info": EXACT,
    "timing": EXACT,
    "rerun": EXACT,
    "demo": EXACT,
    "fim": Tolerance(1e-6, 1e-12),
    "design": Tolerance(1e-6, 1e-6),
    "estimate": Tolerance(1e-3, 1e-9),
    "report": Tolerance(1e-3, 1e-9),
    "campaign": Tolerance(1e-3, 1e-9),
    "actor": Tolerance(0.0, 0.05),
}
DEVIATIONS = 1e-3
"""Of a standard deviation: by so much may an estimate, and an end of its interval, lie elsewhere."""
PAIRED = 0.005
"""Mean difference of D and E over the same brakes [nat]."""

# ---- running commands --------------------------------------------------------------------------------------------


class Done(NamedTuple):
    """Answer of a command."""

    code: int
    out: str
    err: str


class Spent(NamedTuple):
    """Time and memory of a command."""

    wall: float
    """[s]."""
    processor: float
    """[s]."""
    memory: float
    """Largest resident set [MiB]."""


class Checkout:
    """A checkout with its environment, whose commands are typed in a folder of their own."""

    def __init__(self, python: Path, folder: Path) -> None:
        self.python = python.absolute()
        self.root = self.python.parents[2]
        self.folder = folder
        self.environment = dict(os.environ, OMP_NUM_THREADS="1", COLUMNS="120", TZ="UTC")
        self.environment["PYTHONPATH"] = str(self.root / "examples" / "drives")  # the simulated drives

    def type(self, name: str, *arguments: str, where: Path | None = None) -> Done:
        """Type a command of COMMANDS."""
        script, *subcommand = COMMANDS[name]
        if name == "run" and "--bench" not in arguments:
            arguments = (*arguments, "--bench", SENSOR)
        return self.start([str(self.python.parent / script), *subcommand, *arguments], where)

    def start(self, command: list[str], where: Path | None = None) -> Done:
        """Run anything in the folder."""
        done = subprocess.run(
            command, cwd=where or self.folder, env=self.environment, capture_output=True, text=True, check=False
        )
        return Done(done.returncode, done.stdout, done.stderr)

    def says(self, name: str, *arguments: str) -> dict[str, Any]:
        """Exit code and JSON document of a command, or its last line on the error stream."""
        done = self.type(name, *arguments)
        try:
            document = json.loads(done.out.splitlines()[-1])
        except (IndexError, ValueError):
            document = (done.err.splitlines() or [""])[-1]
        return {"code": done.code, "says": document}

    def python_says(self, program: str, *arguments: str) -> Any:
        """JSON of a program that imports the checkout's packages; run in its root."""
        done = self.start([str(self.python), "-c", program, *arguments], self.root)
        if done.code:
            raise RuntimeError(done.err)
        return json.loads(done.out)


# ---- logs --------------------------------------------------------------------------------------------------------

SIMULATED = {
    "clean": ["--iface", "sim:seed=11"],
    "second": ["--iface", "sim:seed=12"],
    "third": ["--iface", "sim:seed=13"],
    "worn": ["--iface", "sim:seed=14,f_v=3e-5,k_1=18,T_c=0.013,k_m=0.019"],
    "delay": ["--iface", "sim:seed=15,plant=late", "--bench", "late.toml", "--policy", "late.onnx"],
    "mapped": ["--iface", "map:{root}/examples/drives/odrive.toml@sim-drive:odrive",
               "--bench", "late.toml", "--policy", "late.onnx"],
    "misfit": ["--iface", "sim:seed=17,plant=stribeck"],
    "disturbed": ["--iface", "sim:seed=18,plant=jitter,velocity_noise=1.6,angle_noise=1.5e-3"],
    "aborted": ["--iface", "sim:seed=19,k_1=80"],
}  # fmt: skip
ALL = (
    "clean",
    "lossy",
    "cut",
    "damaged",
    "worn",
    "delay",
    "mapped",
    "misfit",
    "disturbed",
    "several",
    "emps",
    "aborted",
)
SEVERAL = ("clean", "second", "third")
MODEL = {"misfit": "exact", "disturbed": "exact", "delay": "late"}
METHODS = {"oem": [], "pem": ["--starts", "2"], "rls": [], "windows": ["--window", "0.04"]}
EMPS_MAP = """\
schema = 1
name = "EMPS"
[timing]
column = "t"
unit = "s"
sample_time = 1e-3
[signals.angle]
column = "qm"
unit = "m"
noise = 1.44e-8
[signals.command]
column = "vir"
unit = "N"
scale = 35.1506519
between = "linear"
[machine]
window = 0.08
nuisances = ["current_offset"]
[machine.guess]
mass = 80.0
F_c = 15.0
F_v = 150.0
"""
BENCH = "runtime/emb_runtime/config/bench.toml"
SENSOR = "sensor.toml"
"""That file as it was when this was frozen: the velocity is measured, and no observer's."""


def files(checkout: Checkout, policies: bool = True) -> None:
    """Bench files, and policies."""
    text = (checkout.root / BENCH).read_text(encoding="utf-8")
    text = re.sub(r"(?ms)^\[sensors\].*?(?=^\[)", "", text)
    (checkout.folder / SENSOR).write_text(text, encoding="utf-8")
    changes = {
        "late": (r"frame_age +=.*", "frame_age = [0, 2]"),
        "short": (r"horizon +=.*", "horizon = 50"),
        "slow": (r"velocity = 500.0.*", "velocity = 450.0"),
    }
    for name, (old, new) in changes.items():
        (checkout.folder / f"{name}.toml").write_text(re.sub(old, new, text, count=1), encoding="utf-8")
    (checkout.folder / "emps_map.toml").write_text(EMPS_MAP, encoding="utf-8")
    (checkout.folder / "emps_held.toml").write_text(EMPS_MAP.replace('"linear"', '"held"'), encoding="utf-8")
    if not policies:
        return
    require(checkout.type("export", "chirp:f1=20", "--bench", "late.toml", "--output", "late.onnx"))
    for name, later in (("nan", "nan"), ("beyond", "1e9")):
        program = (
            "import sys, pathlib, json; from tests.actors import constant_actor; "
            "from emb_runtime.config.bench import load_bench; "
            "pathlib.Path(sys.argv[1]).write_bytes(constant_actor(load_bench(), 2.0, float(sys.argv[2]))); print(0)"
        )
        checkout.python_says(program, str(checkout.folder / f"{name}.onnx"), later)


def require(done: Done) -> None:
    """End where a command that all rests on fails."""
    if done.code:
        raise SystemExit(f"freeze: a command failed with {done.code}: {done.err}")


def logs(checkout: Checkout, emps: Path) -> dict[str, Any]:
    """Make the logs; gives their summaries, and a digest of the frames on the bus."""
    said: dict[str, Any] = {}
    for name, arguments in SIMULATED.items():
        given = [argument.format(root=checkout.root) for argument in arguments]
        said[name] = checkout.says("run", *given, "--log", f"{name}.mcap", "--json")
        path = checkout.folder / f"{name}.mcap"
        said[name]["frames"] = frames(path) if path.is_file() else "no log"
    clean = checkout.folder / "clean.mcap"
    rewrite(clean, checkout.folder / "cut.mcap", cut=True)
    rewrite(clean, checkout.folder / "damaged.mcap", damaged=True)
    rewrite(clean, checkout.folder / "lossy.mcap", lost=23)
    if emps.is_file():
        shutil.copy(emps, checkout.folder / "emps.mat")
    return said


def frames(path: Path) -> str:
    """Digest of identifier and bytes of each frame on the bus, in the order of the log."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    from mcap.reader import make_reader

    digest, classes = hashlib.sha256(), dict[int, Any]()
    with path.open("rb") as file:
        for schema, _, message in make_reader(file).iter_messages(FRAMES):
            assert schema is not None
            if schema.id not in classes:
                pool = descriptor_pool.DescriptorPool()
                for part in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(part)
                classes[schema.id] = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            frame = classes[schema.id].FromString(message.data)
            digest.update(frame.id.to_bytes(4, "big") + frame.data)
    return digest.hexdigest()[:16]


CHUNK = 200
"""Messages in a chunk of a log that is written again; in one of emb-run it depends on how long the run took."""
CHUNKS = 12
"""Whole chunks in the cut one; the next is the damaged one."""


def rewrite(source: Path, target: Path, *, cut: bool = False, damaged: bool = False, lost: int = 0) -> None:
    """Copy a log, with all messages of each ``lost``-th sample left out; then cut it, or change bytes of it."""
    from mcap.stream_reader import StreamReader

    with source.open("rb") as file:
        records: list[Any] = list(StreamReader(file).records)
    topics = {r.id: r.topic for r in records if hasattr(r, "topic")}
    samples = [r.log_time for r in records if hasattr(r, "sequence") and topics[r.channel_id] == CYCLES]
    missing = set(samples[lost:-lost:lost]) if lost else set()
    with target.open("wb") as out:
        ends = _written(out, [r for r in records if not (hasattr(r, "sequence") and r.log_time in missing)])
    middle = (ends[CHUNKS - 1] + ends[CHUNKS]) // 2
    data = bytearray(target.read_bytes())
    if cut:
        del data[middle:]
    if damaged:
        data[middle : middle + 64] = bytes(b ^ 0xA5 for b in data[middle : middle + 64])
    target.write_bytes(data)


def _written(out: BinaryIO, records: list[Any]) -> list[int]:
    """Write records; gives where chunks end."""
    from mcap.writer import Writer

    writer: Any = Writer(out, chunk_size=1 << 30)
    schemas, channels, ends, count = {0: 0}, dict[int, int](), list[int](), 0
    for r in records:
        kind = type(r).__name__
        if kind == "Header":
            writer.start(r.profile, r.library)
        elif kind == "Schema" and r.id not in schemas:
            schemas[r.id] = writer.register_schema(r.name, r.encoding, r.data)
        elif kind == "Channel" and r.id not in channels:
            schema = schemas[r.schema_id]
            channels[r.id] = writer.register_channel(r.topic, r.message_encoding, schema, r.metadata)
        elif kind == "Message":
            writer.add_message(channels[r.channel_id], r.log_time, r.data, r.publish_time, r.sequence)
            count += 1
            if count % CHUNK == 0:
                writer.flush()
                ends.append(out.tell())
        elif kind == "Attachment":
            writer.add_attachment(r.create_time, r.log_time, r.name, r.media_type, r.data)
        elif kind == "Metadata":
            writer.add_metadata(r.name, r.metadata)
    writer.finish()
    return ends


def paths(checkout: Checkout, name: str, command: str = "") -> list[str]:
    """The files of one of ALL that are there; a recording of others with its map.

    When this was frozen ``fim`` held a command whose course was not stated, and ``estimate`` found it to be linear.
    """
    if name == "emps":
        map_file = "emps_held.toml" if command == "fim" else "emps_map.toml"
        return ["emps.mat", "--map", map_file] if (checkout.folder / "emps.mat").is_file() else []
    wanted = [f"{n}.mcap" for n in (SEVERAL if name == "several" else (name,))]
    return [n for n in wanted if (checkout.folder / n).is_file()]


# ---- sections ----------------------------------------------------------------------------------------------------

Section = Callable[[Checkout], Mapping[str, Any]]

RUNS = {
    "done": ["--iface", "sim"],
    "worn": ["--iface", "sim:seed=3,f_v=4e-5,k_1=15"],
    "quick": ["--iface", "sim", "--quick"],
    "zero": ["--iface", "sim", "--zero"],
    "read-only": ["--iface", "sim", "--read-only", "--duration", "0.2"],
    "one ampere and home": ["--iface", "sim", "--limit", "1", "--home"],
    "usage": ["--iface", "sim:k_m=-0.02"],
    "more velocity than the shield's": ["--iface", "sim:k_m=0.06"],
    "more friction": ["--iface", "sim:T_c=0.05"],
    "out of limits": ["--iface", "sim:plant=rough"],
    "late": ["--iface", "sim:plant=late"],
    "stiff": ["--iface", "sim:k_1=80"],
    "noisy velocity": ["--iface", "sim:velocity_noise=20"],
    "noisy angle": ["--iface", "sim:angle_noise=1"],
    "not finite": ["--iface", "sim", "--policy", "nan.onnx"],
    "beyond contract": ["--iface", "sim", "--policy", "beyond.onnx"],
    "another bench": ["--iface", "sim", "--bench", "slow.toml"],
    "no interface": ["--iface", "can97"],
}
"""Exit codes 0, 2, 3, 4 and 5 and nine faults. Not here: 1 and 6, which no simulated bus brings about."""
OF_A_RUN = (
    "result exit_code stage purpose steps duration_s pairs answered unanswered missed not_obeyed not_taken confirmed "
    "rejected clipped limited returning left angle_min angle_max top_speed top_current estimate goal_reached goal_s "
    "home end_angle end_velocity node_state node_at_rest node_stop_reason last_angle log_messages log_complete dropped"
)


def run_summary(said: dict[str, Any]) -> dict[str, Any]:
    """Part of a run's document that is compared."""
    document = said["says"]
    if isinstance(document, dict):
        said["says"] = {key: document[key] for key in OF_A_RUN.split() if key in renamed(document, "runs")}
    return said


def of_logs(checkout: Checkout) -> Mapping[str, Any]:
    """Summaries of the runs that the logs are of; made by :func:`measure`."""
    raise NotImplementedError


def of_runs(checkout: Checkout) -> Mapping[str, Any]:
    """Exit code and fault of simulated runs."""
    return {
        name: run_summary(checkout.says("run", *arguments, "--log", f"run-{n}.mcap", "--json"))
        for n, (name, arguments) in enumerate(RUNS.items())
    }


CAN = """
import json
from emb_runtime.can.messages import StopReason, load_layout
from emb_runtime.records import NodeState
l, out = load_layout(), {}
def add(name, frame): out[name] = f"{frame.identifier:03x} {frame.data.hex()}"
for n, i in enumerate((0.0, 0.0002, -0.0002, 1.23456, -3.3333, 6.0, -6.0)):
    add(f"command {i} {n}", l.encode_command(n * 2, 14 - n, i, True))
add("command disabled", l.encode_command(14, 0, 0.0, False))
for n, a in enumerate((0.0, 2e-5, -2e-5, 74.565, -9.99999, 100.0, 159.9, -160.0)):
    add(f"angle {a} {n}", l.encode_angle(n, a, n * 987_654_321))
for n, v in enumerate((0.0, 1e-4, -1e-4, 491.3035, -500.0, 799.9, -800.0)):
    add(f"velocity {v} {n}", l.encode_velocity(n, v, (n - 3) * 1.7, list(NodeState)[n % 4], 2 * n + 3))
for n, r in enumerate(StopReason):
    add(f"status {n}", l.encode_status(n, list(NodeState)[n % 4], r, 65533 + n, 0x97EA + n))
for n, c in enumerate((0.0, 1.23456789, 219902.3, -0.5)):
    add(f"charge {c} {n}", l.encode_charge(n, c))
print(json.dumps(out))
"""


def of_can(checkout: Checkout) -> Mapping[str, Any]:
    """Bytes of each message of emb.dbc for a table of values."""
    return dict(checkout.python_says(CAN))


def each(command: str, *arguments: str) -> Section:
    """A command that takes one log; ``fim`` takes a recording of others, too."""
    left_out = ("several",) if command == "fim" else ("several", "emps")

    def section(checkout: Checkout) -> Mapping[str, Any]:
        return {
            name: checkout.says(command, *paths(checkout, name, command), "--json", *arguments, *model(command, name))
            for name in ALL
            if name not in left_out and paths(checkout, name)
        }

    return section


def model(command: str, name: str) -> list[str]:
    """The plant to evaluate with, where it is not the one that was simulated."""
    return ["--model", MODEL[name]] if name in MODEL and command in ("fim", "estimate", "report") else []


def of_estimate(checkout: Checkout) -> Mapping[str, Any]:
    """Each method on each log that it is for."""
    found = {}
    for name in ALL:
        given = paths(checkout, name)
        chosen = ["windows"] if name == "emps" else list(METHODS) if name == "clean" else ["oem", "pem", "rls"]
        chosen = ["oem", "rls"] if name in ("several", "cut", "damaged") else chosen
        for method in chosen if given else ():
            more = [] if name == "emps" else METHODS[method]
            arguments = [*given, "--json", "--method", method, *more, *model("estimate", name)]
            found[f"{name} {method}"] = checkout.says("estimate", *arguments)
    return found


def of_report(checkout: Checkout) -> Mapping[str, Any]:
    """The document beside the page."""
    found = {}
    for name in ALL:
        if given := paths(checkout, name):
            done = checkout.type("report", *given, "-o", f"{name}.html", *model("report", name))
            beside = checkout.folder / f"{name}.json"
            document = json.loads(beside.read_text(encoding="utf-8")) if beside.is_file() else done.err
            if isinstance(document, dict) and isinstance(document.get("estimate"), dict):
                document["estimate"] = {k: v for k, v in document["estimate"].items() if k in REPORTED}
                document["runs"] = [{k: v for k, v in r.items() if k not in UNREPORTED} for r in document["runs"]]
            found[name] = {"code": done.code, "says": document}
    return found


def of_campaign(checkout: Checkout) -> Mapping[str, Any]:
    """All simulated logs, and the damaged ones."""
    given = [
        path for name in (*ALL, "second", "third") if name not in ("several", "emps") for path in paths(checkout, name)
    ]
    return {"all": checkout.says("campaign", *given, "-o", "all.parquet", "--jobs", "1", "--json")}


def of_design(checkout: Checkout) -> Mapping[str, Any]:
    """Two short searches."""
    points = {
        "D of two": ["--criterion", "D", "--params", "k_m,T_c", "--model", "euler"],
        "E of four": ["--criterion", "E", "--theta", "f_v=3e-5"],
    }
    given = ["--bench", "short.toml", "--starts", "2", "--seed", "1", "--json"]
    return {name: checkout.says("design", *given, *arguments) for name, arguments in points.items()}


ACTOR = """
import json, sys
from emb_bench.config.bench import load_bench
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_train.closed_loop import Conditions
from emb_train.play import MEASURES, Estimating, fresh_draws, play
bench = load_bench(sys.argv[2])
ranges, out = bench.range_set("pm50"), {}
draws = fresh_draws(ranges, 0, int(sys.argv[1]))
for name in ("shipped", "quick"):
    policy = load_policy(shipped_actor_path(name == "quick"), bench)
    actor = Estimating(policy, bench)
    p = play(bench, ranges, PARAMETER_NAMES, actor, draws, "exact", Conditions(information="physical"))
    out[name] = {"left": int(p.left.sum()), "home": int(p.home.sum())}
    out[name] |= {m: MEASURES[m].values(p.matrices).round(4).tolist() for m in ("D", "E")}
print(json.dumps(out))
"""
BRAKES = 200


def of_actor(checkout: Checkout) -> Mapping[str, Any]:
    """D and E of the shipped actors on the same brakes with the same noise."""
    return dict(checkout.python_says(ACTOR, str(BRAKES), str(checkout.folder / SENSOR)))


def of_demo(checkout: Checkout) -> Mapping[str, Any]:
    """Numbers that ``make demo`` prints, as they are printed."""
    run = checkout.type("run", "--iface", "sim", "--log", "experiment.mcap")
    told = checkout.type("fim", "experiment.mcap", "--theta", "nominal")
    number = re.compile(r"(?<![\w.])[+−-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
    kept = [line for line in run.out.splitlines() if "bytes" not in line and "log" not in line.split()[:1]]
    return {
        "run": {"code": run.code, "says": " ".join(kept), "numbers": number.findall("\n".join(kept))},
        "fim": {"code": told.code, "says": " ".join(told.out.split()), "numbers": number.findall(told.out)},
    }


SECTIONS: dict[str, Section] = {
    "can": of_can,
    "runs": of_runs,
    "logs": of_logs,
    "fim": each("fim", "--theta", "nominal"),
    "info": each("info"),
    "timing": each("timing"),
    "rerun": each("rerun"),
    "estimate": of_estimate,
    "report": of_report,
    "campaign": of_campaign,
    "design": of_design,
    "actor": of_actor,
    "demo": of_demo,
}
NEED_LOGS = {"logs", "fim", "info", "timing", "rerun", "estimate", "report", "campaign"}
WHOLE = {"actor", "can", "demo"}
"""Sections whose lists are kept whole."""


def measure(checkout: Checkout, wanted: list[str], emps: Path, given: Path | None) -> Iterator[tuple[str, Any]]:
    """Each section, as it is kept."""
    said: dict[str, Any] = {}
    begin = time.monotonic()
    files(checkout, bool((NEED_LOGS | {"runs"}) & set(wanted)))
    if given is not None:
        for path in given.glob("*.mcap"):
            shutil.copy(path, checkout.folder)
    elif NEED_LOGS & set(wanted):
        said = logs(checkout, emps)
    note(f"files and logs: {_since(begin)}")
    for name in wanted:
        begin = time.monotonic()
        found = {k: run_summary(v) for k, v in said.items()} if name == "logs" else SECTIONS[name](checkout)
        note(f"{name}: {_since(begin)}")
        if name != "logs" or found:
            yield name, kept(found, name)


_processor = [0.0]


def _since(begin: float) -> str:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    before, _processor[0] = _processor[0], used.ru_utime + used.ru_stime
    return f"{time.monotonic() - begin:.0f} s, {_processor[0] - before:.0f} s of processor"


def note(text: str) -> None:
    """For who waits."""
    sys.stderr.write(f"freeze: {text}\n")


def say(text: str) -> None:
    """For who asked."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


# ---- documents ---------------------------------------------------------------------------------------------------


def renamed(document: Mapping[str, Any], section: str) -> dict[str, Any]:
    """A document with the frozen names."""
    names = RENAMED.get(section, {})
    return {names.get(key, key): value for key, value in document.items()}


def kept(value: Any, section: str, digits: int = 0) -> Any:
    """A document without what is left out, with members by name in place of lists of them, and rounded."""
    digits = digits or DIGITS.get(section, PRECISE)
    if isinstance(value, Mapping):
        pairs = (
            (k, v) for k, v in renamed(value, section).items() if k not in LEFT_OUT.split() and not _is_time_of_day(v)
        )
        return {k: kept(v, section, PRECISE if _is_estimate(k) else digits) for k, v in pairs}
    if isinstance(value, list):
        for key in NAMES if value and all(isinstance(v, Mapping) for v in value) else ():
            names = [str(v.get(key, "")) for v in value]
            if len(set(names)) == len(names) and "" not in names:
                return {
                    n: kept({k: x for k, x in v.items() if k != key}, section)
                    for n, v in zip(names, value, strict=True)
                }
        if len(value) > LONG and section not in WHOLE:
            chosen = [value[round(i * (len(value) - 1) / (KEPT - 1))] for i in range(KEPT)]
            return {"of": len(value), "some": kept(chosen, section, digits)}
        return [kept(v, section, digits) for v in value]
    if isinstance(value, float):
        return value if not math.isfinite(value) or value == 0 else float(f"{value:.{digits}g}")
    if isinstance(value, str) and section not in WHOLE and re.fullmatch(r"-?\d+\.\d{6,}(e-?\d+)?", value):
        return kept(float(value), section)  # a number as a word, of a log's metadata
    return re.sub(r"\bbyte \d+", "byte …", value) if isinstance(value, str) else value


def _is_estimate(key: str) -> bool:
    return key in ("value", "mean", "true") or key.startswith("interval")


def _is_time_of_day(value: Any) -> bool:
    return isinstance(value, int) and value >= TIMES_OF_DAY


class Comparison:
    """Differences of a section from the frozen one.

    Args:
        section: its name.
        words: whether sentences and new keys count.
    """

    def __init__(self, section: str, words: bool) -> None:
        self.section = section
        self.words = words
        self.tolerance = TOLERANCES[section]
        self.differences: list[str] = []
        self.explained: list[str] = []
        self.sentences = 0
        self.new = 0

    def differ(self, path: str, text: str, tables: tuple[dict[str, str], ...] = (EXPLAINED,)) -> None:
        """Enter a difference, unless a table explains it."""
        why = next((w for table in tables for p, w in table.items() if fnmatch.fnmatch(path, p)), "")
        if why:
            self.explained.append(f"{path}: {text} ({why})")
        else:
            self.differences.append(f"{path}: {text}")

    def compare(self, path: str, old: Any, new: Any, room: float = 0.0) -> None:
        """Compare what is at a path; ``room`` is an absolute tolerance that the values around it give."""
        if isinstance(old, dict) and isinstance(new, dict):
            self._members(path, old, new)
        elif isinstance(old, list) and isinstance(new, list):
            if len(old) != len(new):
                return self.differ(path, f"{len(old)} members became {len(new)}: {_short(old)} to {_short(new)}")
            scale = max([abs(v) for v in _numbers(old)], default=0.0)
            room = max(room, self.tolerance.relative * scale)
            for n, (a, b) in enumerate(zip(old, new, strict=True)):
                self.compare(f"{path}/{n}", a, b, room)
        elif _is_number(old) and _is_number(new):
            if math.isnan(old) and math.isnan(new):
                return None
            allowed = room or max(self.tolerance.relative * max(abs(old), abs(new)), self.tolerance.absolute)
            if not abs(old - new) <= allowed:
                self.differ(path, f"{old} became {new} ({abs(old - new) / allowed:.3g} times what is allowed)")
        elif isinstance(old, str) and isinstance(new, str) and " " in old:
            self.sentences += old != new
            if self.words and old != new:
                self.differ(path, f"'{old}' became '{new}'")
        elif old != new or type(old) is not type(new):
            self.differ(path, f"{_short(old)} became {_short(new)}")
        return None

    def _members(self, path: str, old: dict[str, Any], new: dict[str, Any]) -> None:
        deviation = _deviation(old)
        for key in old:
            at = f"{path}/{key}"
            if key not in new:
                self.differ(at, f"{_short(old[key])} is gone", (GONE, EXPLAINED))
            elif self.section == "actor" and key in ("D", "E"):
                self._paired(at, old[key], new[key])
            else:
                own = key == "sigmas" or _is_estimate(key)
                self.compare(
                    at, old[key], new[key], DEVIATIONS * (1.0 if key == "sigmas" else deviation) if own else 0.0
                )
        for key in new.keys() - old.keys():
            self.new += 1
            if self.words:
                self.differ(f"{path}/{key}", f"{_short(new[key])} is new")

    def _paired(self, path: str, old: list[float], new: list[float]) -> None:
        if len(old) != len(new):
            return self.differ(path, f"{len(old)} brakes became {len(new)}")
        differences = [b - a for a, b in zip(old, new, strict=True)]
        mean, spread = statistics.fmean(differences), statistics.stdev(differences) / math.sqrt(len(old))
        note(f"{path}: mean {statistics.fmean(new):.4f} nat, paired difference {mean:+.5f} ± {1.96 * spread:.5f}")
        if not abs(mean) <= PAIRED:
            self.differ(path, f"the mean over the same brakes changed by {mean:+.4f} ± {1.96 * spread:.4f} nat")
        return None


def _deviation(document: Mapping[str, Any]) -> float:
    """Standard deviation of what a document states: stated, or from its 95 % interval, or from its size in them."""
    value = document.get("value", document.get("mean"))
    if _is_number(value):
        if _is_number(stated := document.get("deviation")):
            return float(stated) * (abs(value) if document.get("deviation_relative") else 1.0)
        for key in ("interval_95", "interval"):
            ends = document.get(key)
            if isinstance(ends, list) and len(ends) == 2 and all(_is_number(end) for end in ends):
                return float(ends[1] - ends[0]) / 3.92
        if _is_number(sigmas := document.get("sigmas")) and sigmas:
            return abs(value / sigmas)
    return 0.0


def _is_number(value: Any) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, list):
        for v in value:
            yield from _numbers(v)
    elif _is_number(value) and math.isfinite(value):
        yield value


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) < 100 else text[:97] + "..."


def text_of(document: Any) -> str:
    """One line for each name, so that a diff says which one changed."""
    lines = [
        f"{json.dumps(k)}: {json.dumps(v, ensure_ascii=False, separators=(',', ':'))}" for k, v in document.items()
    ]
    return "{\n" + ",\n".join(lines) + "\n}\n"


# ---- times -------------------------------------------------------------------------------------------------------

TURNS = 3


def times(ours: Checkout, theirs: Checkout) -> None:
    """Medians of some turns, each with both checkouts, and their ratio: ours over theirs."""
    for checkout in (ours, theirs):
        files(checkout, policies=False)
        require(checkout.type("run", "--iface", "sim:seed=11", "--log", "clean.mcap"))
    plays: dict[str, tuple[list[str], bool]] = {
        "fim, first": (["fim", "clean.mcap"], True),
        "fim": (["fim", "clean.mcap"], False),
        "estimate, first": (["estimate", "clean.mcap"], True),
        "estimate": (["estimate", "clean.mcap"], False),
        "report": (["report", "clean.mcap", "-o", "page.html"], False),
        "emb-run --iface sim": (["run", "--iface", "sim", "--log", "{new}.mcap"], False),
    }
    say(f"{'':24}{'ours':>30}{'theirs':>30}{'ratio':>20}")
    say(f"{'':24}{'wall    processor    memory':>30}{'wall    processor    memory':>30}{'wall   processor':>20}")
    for name, (arguments, first) in plays.items():
        spent: dict[Checkout, list[Spent]] = {ours: [], theirs: []}
        for turn in range(TURNS):
            for checkout in (ours, theirs) if turn % 2 == 0 else (theirs, ours):
                spent[checkout].append(_timed(checkout, arguments, first, turn))
        a, b = (Spent(*(statistics.median(v) for v in zip(*spent[c], strict=True))) for c in (ours, theirs))
        cells = "".join(f"{s.wall:10.2f} s{s.processor:8.2f} s{s.memory:6.0f} MiB" for s in (a, b))
        say(f"{name:24}{cells}{a.wall / b.wall:10.2f}{a.processor / b.processor:10.2f}")
    for checkout in (ours, theirs):
        done = checkout.start([str(checkout.python), "benchmarks/cycle.py", "--seconds", "3"], checkout.root)
        say(f"benchmarks/cycle.py of {'ours' if checkout is ours else 'theirs'}:\n{done.out}")


def _timed(checkout: Checkout, arguments: list[str], first: bool, turn: int) -> Spent:
    """One command, with an empty folder for compiled functions if it is the first one."""
    script, *subcommand = COMMANDS[arguments[0]]
    filled = [a.format(new=f"new-{turn}-{time.monotonic_ns()}") for a in arguments[1:]]
    environment = dict(checkout.environment)
    if first:
        environment["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(dir=checkout.folder)
    begin = time.monotonic()
    with (checkout.folder / "said.txt").open("w") as said:
        process = subprocess.Popen(
            [str(checkout.python.parent / script), *subcommand, *filled],
            cwd=checkout.folder,
            env=environment,
            stdout=said,
            stderr=said,
        )
        _, status, used = os.wait4(process.pid, 0)
    if code := os.waitstatus_to_exitcode(status):
        raise SystemExit(f"freeze: {arguments} failed with {code}: {(checkout.folder / 'said.txt').read_text()}")
    return Spent(time.monotonic() - begin, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


# ---- command line ------------------------------------------------------------------------------------------------


def main() -> int:
    """Run; see the module."""
    parser = argparse.ArgumentParser(prog="python -m tools.freeze", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", action="store_true", help="compare, and write nothing")
    parser.add_argument("--only", action="append", choices=SECTIONS, help="a section; repeatable (default: all)")
    parser.add_argument("--words", action="store_true", help="sentences and new keys count too")
    parser.add_argument("--python", type=Path, default=Path(sys.executable), help="of the checkout that is measured")
    parser.add_argument("--times", type=Path, metavar="PYTHON", help="of another checkout: measure both, in turns")
    parser.add_argument("--frozen", type=Path, default=FOLDER, help="folder of the frozen data (default: tests/freeze)")
    parser.add_argument("--logs", type=Path, metavar="DIR", help="read the logs there, and make none")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="leave the logs there")
    parser.add_argument("--emps", type=Path, default=Path("DATA_EMPS.mat"), help="left out where there is none")
    options = parser.parse_args()
    with contextlib.ExitStack() as stack:
        folders = [Path(stack.enter_context(tempfile.TemporaryDirectory())) for _ in range(2)]
        checkout = Checkout(options.python, folders[0])
        if options.times:
            times(checkout, Checkout(options.times, folders[1]))
            return 0
        code = 0
        for section, document in measure(checkout, options.only or list(SECTIONS), options.emps, options.logs):
            path = options.frozen / f"{section}.json"
            if options.check:
                code |= compared(section, json.loads(path.read_text(encoding="utf-8")), document, options.words)
            else:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text_of(document), encoding="utf-8")
        if options.keep:
            options.keep.mkdir(parents=True, exist_ok=True)
            for log in checkout.folder.glob("*.mcap"):
                shutil.copy(log, options.keep)
    return code


def compared(section: str, old: Any, new: Any, words: bool) -> int:
    """Print what differs; 1 if something does."""
    if "emps" not in str(list(new)):
        old = {key: value for key, value in old.items() if not key.startswith("emps")}
    comparison = Comparison(section, words)
    comparison.compare(section, old, json.loads(json.dumps(new)))
    for line in comparison.differences:
        say(line)
    found, explained = len(comparison.differences), len(comparison.explained)
    say(
        f"{section}: {found} differences, {explained} explained, {comparison.sentences} sentences in other words, "
        f"{comparison.new} new keys"
    )
    return min(found, 1)


if __name__ == "__main__":
    sys.exit(main())
