"""Columns of foreign files: CSV, Parquet, MATLAB, MDF, CAN frames.

Each library is imported when it is needed.
"""

from __future__ import annotations

import csv
import gc
import re
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.experiment.experiment import Lack
from emb_bench.recordings.map_file import Place, Source
from emb_runtime.can.codec import parse
from emb_runtime.drives.dbc import MAX_DBC_BYTES, find_messages
from emb_runtime.errors import EmbError, FrameError, UsageError, needs
from emb_runtime.system.input_file import decode, open_regular, read_bytes

Floats = NDArray[np.float64]
Entered = dict[Lack, tuple[float, ...]]
Read = tuple[Place, Any, Any]

MOST = 5_000_000  # Most rows of a recording
MOST_BYTES = 2 << 30  # Largest CSV file
NAMED = 12  # Most columns that a message names
HEADS = 1000  # First lines of a CSV file among which its head is looked for
DELIMITERS: Mapping[str, str] = {",": ",", ";": ";", "|": "|", "tab": "\t", " ": " "}
MISSING = ("", "nan", "NaN", "NAN", "-nan", "null", "NULL", "None", "NA", "N/A", "n/a", "#N/A")
"""Texts that stand for a missing number in any CSV file."""


class Column(NamedTuple):
    """One column of a recording."""

    values: Floats  # Shape (n,)
    time: Floats | None  # Of each value [s], shape (n,); None where the format has no times of its own


def read_columns(
    path: Path, kind: str, source: Source, places: Sequence[Place], lacks: Entered, folder: Path = Path()
) -> dict[Place, Column]:
    """Columns of a file of a kind; ``struct.field`` and ``matrix(:,1)`` inside MATLAB structures.

    Enters in ``lacks`` what was passed over. The DBC of CAN frames lies in the ``folder``.
    """
    readers: Mapping[str, tuple[str, Callable[[], Iterator[Read]]]] = {
        "csv": ("CSV", lambda: _csv(path, source, places, lacks)),
        "parquet": ("Parquet", lambda: _parquet(path, source, places)),
        "matlab": ("MATLAB", lambda: _matlab(path, places)),
        "mdf": ("MDF", lambda: _mdf(path, places)),
        "can": ("CAN frames", lambda: _can(path, source, places, lacks, folder)),
    }
    title, read = readers[kind]
    found = {}
    try:
        open_regular(path).close()
    except OSError as err:
        raise UsageError(f"{path}: cannot read the recording: {err.strerror}") from err
    if kind != "mdf" and (numbered := [place.column for place in places if place.group is not None]):
        raise UsageError(f"{path}: {numbered[0]}: only an MDF has groups: leave group out")
    first, last = source.rows or (1, MOST + 1)
    with _errors_in_one_line(path, title):
        for place, values, time in read():
            row = _numbers(path, place.column, values)[first - 1 : last]
            found[place] = Column(row, None if time is None else _numbers(path, place.column, time)[first - 1 : last])
    for place, column in found.items():
        if not 2 <= len(column.values) <= MOST:
            raise UsageError(f"{path}: {place.column}: expected 2 to {MOST} values, got {len(column.values)}")
    return found


@contextmanager
def _errors_in_one_line(path: Path, kind: str) -> Iterator[None]:
    try:
        with needs(f"{path}: reading {kind}", "mdf"):
            yield
    except EmbError:
        raise
    except Exception as err:  # the errors of these libraries share no base class
        _let_go(err)
        message = " ".join(str(err).split())[:120] or type(err).__name__
        raise UsageError(f"{path}: not readable as {kind}: {message}") from err


def _let_go(err: Exception) -> None:
    """Collects the unfinished objects of a library, and discards the complaints of their finalizers."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    one: BaseException | None = err
    try:
        while one is not None:
            traceback.clear_frames(one.__traceback__)
            one = one.__context__
        gc.collect()
    finally:
        sys.unraisablehook = hook


def _require_one(path: Path, name: str, places: Sequence[Any], columns: Sequence[str], more: str = "") -> None:
    if not places:
        others = ", ".join(columns[:NAMED]) + (", ..." if len(columns) > NAMED else "")
        raise UsageError(f"{path}: no column is called {name!r}; it has: {others or 'none'}{more}")
    if len(places) > 1:
        raise UsageError(f"{path}: {len(places)} columns are called {name!r}: expected one{more}")


def _numbers(path: Path, name: str, values: Any) -> Floats:
    if np.iscomplexobj(values):
        raise UsageError(f"{path}: {name}: expected real numbers, got complex ones")
    try:
        row: Floats = np.squeeze(np.asarray(values, dtype=np.float64))
    except (TypeError, ValueError) as err:
        raise UsageError(f"{path}: {name}: expected numbers") from err
    if row.ndim == 2:
        ends = f"{name}(:,1) to {name}(:,{row.shape[1]})"
        raise UsageError(f"{path}: {name}: a matrix of {row.shape[0]} x {row.shape[1]}: name a column of it, {ends}")
    if row.ndim != 1:
        raise UsageError(f"{path}: {name}: expected one row of numbers, got an array of shape {np.shape(values)}")
    return row


# ---- tables ----


def _csv(path: Path, source: Source, places: Sequence[Place], lacks: Entered) -> Iterator[Read]:
    import pyarrow as pa
    from pyarrow.csv import ConvertOptions, ParseOptions, ReadOptions, read_csv

    content = read_bytes(path, MOST_BYTES)
    try:
        text = decode(content, source.encoding)
    except UnicodeDecodeError as err:
        line = content.count(b"\n", 0, err.start) + 1
        tried = source.encoding or "UTF-8 or cp1252"
        raise UsageError(f"{path}: line {line}: not text in {tried}: [file] encoding names another one") from err
    if text[:2].count("\0") == 1 and not source.encoding:
        order = "le" if text[1] == "\0" else "be"
        raise UsageError(f'{path}: UTF-16 without its mark: [file] encoding = "utf-16-{order}" reads it')
    delimiter = DELIMITERS[source.delimiter]
    if delimiter == " ":  # columns may be aligned by several
        text = re.sub(r"(?m)^ +| +(?= |$)", "", text)
    line, titles = _head(path, text, source, places)
    if line > 1 and source.head is None:
        lacks[Lack.HEAD] = (line,)
    before, (_, last) = line + source.skip, source.rows or (1, MOST)
    unfit = list[str]()

    def handle_row(row: Any) -> str:
        """Skips a last row that is cut, and the rows after the last one of the map; refuses any other."""
        if text.endswith(f"\n{row.text}") or row.number - before > last:
            return "skip"
        unfit.append(f"line {row.number}: expected {row.expected_columns} columns, got {row.actual_columns}")
        unfit.append(f"[file] rows = [1, {row.number - before - 1}] reads those before it")
        return "error"

    try:
        table = read_csv(
            pa.BufferReader(text.encode()),
            ReadOptions(skip_rows=before, column_names=titles, use_threads=False),
            ParseOptions(delimiter=delimiter, invalid_row_handler=handle_row),
            ConvertOptions(
                decimal_point=source.decimal, null_values=[*MISSING, *source.missing], strings_can_be_null=True
            ),
        )
    except pa.ArrowInvalid:
        if unfit:
            raise UsageError(f"{path}: {': '.join(unfit[:2])}") from None
        raise
    return _arrow(path, table, source, places)


def _split(line: str, delimiter: str) -> list[str]:
    """Names or numbers of a line, without the mark of a comment before it and a semicolon behind it."""
    plain = line.strip("\r").lstrip("%# ").removesuffix("" if delimiter == ";" else ";")
    return [part.strip() for part in next(csv.reader([plain], delimiter=delimiter), [])]


def _is_number(text: str) -> bool:
    try:
        float(text.strip(" \t;\"'"))
    except ValueError:
        return False
    return True


def _head(path: Path, text: str, source: Source, places: Sequence[Place]) -> tuple[int, list[str]]:
    """Line of the head, the first being 1, and the name of each column; 0 and numbers where there is none."""
    lines = re.split(r"\r\n|\n|\r", text[: 1 << 20])[: max(HEADS, source.head or 0)]
    delimiter, required = DELIMITERS[source.delimiter], {place.column for place in places}
    if (source.head or 0) > len(lines):
        raise UsageError(f"{path}: [file] head = {source.head}: expected one of its {len(lines)} lines")
    if source.head == 0:
        at, titles = -1, [str(n + 1) for n, _ in enumerate(_split(lines[0], delimiter))]
    else:
        among = range(len(lines)) if source.head is None else range(source.head - 1, min(source.head, len(lines)))
        at = max(among, key=lambda i: len(required & {*_split(lines[i], delimiter)}), default=0)
        titles = _split(lines[at], delimiter)
    if missing := [place.column for place in places if place.column not in titles]:
        _require_one(path, missing[0], (), titles, _remedy(lines, at, titles, source, required))
    first = next((line for line in lines[at + 1 + source.skip :] if line.strip()), "")
    width = len(_split(first, delimiter))  # some put a delimiter at the end of a head or of each row
    return at + 1, (titles + [""] * (width - len(titles)))[: None if any(titles[width:]) else width]


def _remedy(lines: Sequence[str], at: int, titles: Sequence[str], source: Source, required: set[str]) -> str:
    """Key of the map that may find the columns of a CSV file; else the line that was taken for its head."""
    if at >= 0 and titles and all(map(_is_number, titles)):
        return f". No head: its first line is numbers; with [file] head = 0 columns are 1 to {len(titles)}"
    for name, other in DELIMITERS.items():
        fits = [i for i, line in enumerate(lines) if required <= {*_split(line, other)}]
        if fits and name != source.delimiter:
            return f'. With [file] delimiter = "{name}" line {fits[0] + 1} has them'
    if at > 0:
        return f" in line {at + 1}, taken for the head: [file] head names another line"
    foreign = not source.encoding and not all(name.isascii() for name in titles)
    return ". If these names look wrong, [file] encoding names the file's" if foreign else ""


def _parquet(path: Path, source: Source, places: Sequence[Place]) -> Iterator[Read]:
    from pyarrow import parquet

    names = {place.column for place in places}
    with parquet.ParquetFile(path) as file:
        every = file.schema_arrow.names
        return _arrow(path, file.read(columns=[name for name in every if name.strip() in names]), source, places, every)


def _arrow(
    path: Path, table: Any, source: Source, places: Sequence[Place], names: Sequence[str] | None = None
) -> Iterator[Read]:
    for place in places:
        name = place.column
        at = [i for i, title in enumerate(table.column_names) if title.strip() == name]
        _require_one(path, name, at, names or table.column_names)
        column, kind = table.column(at[0]), str(table.column(at[0]).type)
        if kind.startswith(("time", "duration")):  # or a timestamp
            fine = re.sub(r"^time(?:32|64)", "time64", re.sub(r"\[.*", "[ns]", kind))
            counts = column.cast(fine).cast("int64").to_numpy()
            yield place, (counts - counts[np.isfinite(counts)][:1].sum()) * 1e-9, None
        elif kind in ("string", "large_string"):
            yield place, _of_texts(path, name, column.to_pylist(), source), None
        else:
            yield place, column.to_numpy(), None


_CLOCK = re.compile(r"(\d\d?):(\d\d):(\d\d(?:\.\d*)?)")  # Without a fraction it is a time of Arrow's


def _of_texts(path: Path, name: str, texts: Sequence[str | None], source: Source) -> Floats:
    """Numbers of a column that has texts, too."""
    values = np.full(len(texts), np.nan)
    first, last = source.rows or (1, MOST)
    for i, text in enumerate(texts):
        plain = (text or "").strip(" \t;\"'")
        if plain in MISSING or plain in source.missing or not first <= i + 1 <= last:
            continue
        if clock := _CLOCK.fullmatch(plain):
            values[i] = 3600.0 * int(clock[1]) + 60.0 * int(clock[2]) + float(clock[3])
            continue
        number = (plain.replace(",", ".") if source.decimal == "," else plain).replace("D", "E")  # of Fortran
        if not _is_number(number):
            remedy = (
                '[file] decimal = "," reads it' if _is_number(plain.replace(",", "."))
                else "[file] skip = 1 leaves out a line of units" if i == 0
                else f"[file] missing = [{plain!r}] leaves such out, rows = [1, {i}] all from there on"
            )  # fmt: skip
            raise UsageError(f"{path}: {name}: row {i + 1}: expected a number, got {plain[:40]!r}: {remedy}")
        values[i] = float(number)
    return values


# ---- MATLAB, MDF ----

_INDEX = re.compile(r"(.*?)[({]\s*(:|[1-9]\d*)\s*(?:,\s*(:|[1-9]\d*)\s*)?[)}]")


def _matlab(path: Path, places: Sequence[Place]) -> Iterator[Read]:
    from scipy import io

    with open_regular(path) as file:
        if file.read(10) == b"MATLAB 7.3":
            raise UsageError(f"{path}: a file of MATLAB 7.3: save it with -v7")
    content = io.loadmat(path, squeeze_me=True, struct_as_record=False, simplify_cells=True)
    columns = [text for key, value in content.items() if not key.startswith("__") for text in _inside(key, value)]
    for place in places:
        value: Any = content
        for part in place.column.split("."):
            indexed = _INDEX.fullmatch(part)
            name = part if indexed is None else indexed[1]
            found = [value[name]] if isinstance(value, Mapping) and name in value else []
            _require_one(path, place.column, found, columns)
            value = found[0]
            if indexed is not None:
                value = _part(path, indexed, value)
        yield place, value, None


def _inside(name: str, value: Any) -> Iterator[str]:
    """Names of the fields and columns inside a variable of MATLAB."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _inside(f"{name}.{key}", inner)
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from _inside(f"{name}({i + 1})", inner)
    else:
        yield f"{name}(:,1..{np.shape(value)[1]})" if np.ndim(value) == 2 else name


def _part(path: Path, indexed: re.Match[str], value: Any) -> Any:
    """Part of an array by an index as MATLAB has it, ``name(1)`` or ``name(:,2)``."""
    numbers = [slice(None) if index == ":" else int(index) - 1 for index in indexed.groups()[1:] if index]
    try:
        if isinstance(value, Mapping) and numbers == [0]:  # one structure is an array of one
            return value
        return value[tuple(numbers)] if isinstance(value, np.ndarray) else value[numbers[0]]
    except (IndexError, KeyError, TypeError) as err:
        raise UsageError(f"{path}: {indexed[0]}: beyond what {indexed[1]} has: {np.shape(value)}") from err


def _mdf(path: Path, places: Sequence[Place]) -> Iterator[Read]:
    from asammdf import MDF

    with MDF(path) as file:
        columns = sorted(name for name in file.channels_db if name not in ("time", "t"))
        for place in places:
            every = file.channels_db.get(place.column, ())
            found = [at for at in every if place.group in (None, at[0])]
            groups = [f"{number} ({file.groups[number].channel_group.cycles_nr} values)" for number, _ in every]
            more = f"; it is in the groups {', '.join(groups)}: group = N of the signal names one" if groups else ""
            _require_one(path, place.column, found, columns, more)
            signal = file.get(group=found[0][0], index=found[0][1])
            yield place, signal.samples, signal.timestamps


# ---- CAN frames ----


def _can(path: Path, source: Source, places: Sequence[Place], lacks: Entered, folder: Path) -> Iterator[Read]:
    import can

    signals = _signals(folder / source.dbc, places)
    of = dict[tuple[bool, int], dict[str, Any]]()
    for message, _ in signals.values():
        of.setdefault((message.is_extended_frame, message.frame_id), {})[message.name] = message
    rows, channels = dict[tuple[str, str], list[tuple[float, Any]]](), dict[tuple[bool, int], Any]()
    others, elsewhere, unread = Counter[str](), Counter[str](), Counter[str]()
    with can.LogReader(path) as frames:
        for frame in frames:
            if source.channel not in ("", str(frame.channel)):
                elsewhere[str(frame.channel)] += 1
                continue
            key = frame.is_extended_id, frame.arbitration_id
            identifier = _identifier(*key)
            if key not in of or frame.is_error_frame or frame.is_remote_frame:
                others["error frames" if frame.is_error_frame else identifier] += 1
                continue
            if (first := channels.setdefault(key, frame.channel)) != frame.channel:
                where = f"channels {first} and {frame.channel}"
                raise UsageError(f"{path}: {identifier} comes on {where}: [file] channel names one")
            for message in of[key].values():
                values = _decoded(message, frame.data)
                if values is None:
                    unread[f"{message.name} of {len(frame.data)} bytes, in the DBC {message.length}"] += 1
                for name, value in (values or {}).items():
                    rows.setdefault((message.name, name), []).append((frame.timestamp, value))
    passed = {Lack.OTHER_FRAMES: (others.total(), len(others)), Lack.BAD_FRAMES: (unread.total(),)}
    lacks.update({lack: numbers for lack, numbers in passed.items() if numbers[0]})
    for place, (message, name) in signals.items():
        if not (found := rows.get((message.name, name), [])):
            identifier = _identifier(message.is_extended_frame, message.frame_id)
            why = _passed(
                {"do not fit the DBC": unread, "have other numbers": others, "have other channels": elsewhere}
            )
            raise UsageError(f"{path}: {place.column}: no frame {identifier} has it: {why}")
        yield place, [value for _, value in found], [time for time, _ in found]


def _passed(counted: Mapping[str, Counter[str]]) -> str:
    """Says which frames were passed over, by the reason."""
    parts = [
        f"{counts.total()} {reason}, {', '.join(f'{key} ({n})' for key, n in counts.most_common(NAMED))}"
        for reason, counts in counted.items()
        if counts
    ]
    return "; ".join(parts) or "the file has none"


def _identifier(extended: bool, number: int) -> str:
    return f"{number:#x} of 29 bits" if extended else f"{number:#x}"


def _decoded(message: Any, data: Any) -> Mapping[str, Any] | None:
    """Values of a frame; None if it does not fit the DBC."""
    try:
        found: Mapping[str, Any] = message.decode(bytes(data), decode_choices=False)
    except Exception:  # cantools raises several kinds
        return None
    return found


def _signals(dbc: Path, places: Sequence[Place]) -> dict[Place, tuple[Any, str]]:
    """Message of cantools, and name of the signal, of each column."""
    try:
        messages = find_messages(decode(read_bytes(dbc, MAX_DBC_BYTES)))
    except (OSError, UnicodeDecodeError, FrameError) as err:
        reason = err.strerror if isinstance(err, OSError) else err
        raise UsageError(f"{dbc}: cannot read the DBC: {reason}") from err
    names = [(of, name) for of, found in messages.items() for name in re.findall(r"(?m)^ SG_ (\w+)", found.text)]
    faults = "".join(f"; {of} is not readable: {found.fault}" for of, found in messages.items() if found.fault)
    made, result = dict[str, Any](), dict[Place, tuple[Any, str]]()
    for place in places:
        of, _, signal = place.column.rpartition(".")
        columns = [f"{message}.{name}" for message, name in names]
        found = [(message, name) for message, name in names if name == signal and of in ("", message)]
        several = f": {', '.join('.'.join(pair) for pair in found)}" if found else faults
        _require_one(dbc, place.column, found, columns, several)
        try:
            made[found[0][0]] = made.get(found[0][0]) or parse(messages[found[0][0]].text).messages[0]
        except FrameError as err:
            raise UsageError(f"{dbc}: {found[0][0]}: {err}") from err
        result[place] = made[found[0][0]], signal
    return result
