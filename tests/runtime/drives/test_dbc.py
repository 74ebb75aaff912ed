"""The DBC of a mapping, damaged or made to be large: one line, or the messages that the mapping names as they are."""

from __future__ import annotations

import random
import resource
from collections.abc import Callable

import pytest

from emb_runtime.drives.dbc import MAX_DBC_BYTES, MOST_PAGES, MOST_STATEMENTS
from emb_runtime.drives.mapping import Mapping, MappingError
from emb_runtime.drives.mapping_file import parse_mapping
from tests.drives import EXAMPLES

TOML, DBC = ((EXAMPLES / f"odrive.{kind}").read_text() for kind in ("toml", "dbc"))
TORQUE = ' SG_ Input_Torque : 0|32@1- (1,0) [0|0] "Nm" Axis0'
OTHERS = """\
CM_ "a DBC; BO_ 14 Axis0_Set_Input_Torque: 8 X
BO_ 14 Axis0_Set_Input_Torque: 8 X";
CM_ SG_ 14 Input_Torque "said \\"so\\"";  // BO_ 14 Axis0_Set_Input_Torque: 8 X
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","StandardCAN_FD";
BA_ "VFrameFormat" BO_ 77 14;
VAL_ 14 Input_Torque 0 "SIG_VALTYPE_ 9 Pos_Estimate : 2;" ;
"""


def read(dbc: str, toml: str = TOML) -> Mapping | str:
    """The mapping, or the line by which it is refused."""
    try:
        return parse_mapping(toml, dbc, "drive.toml")
    except MappingError as err:
        message = str(err)
        assert message.isprintable()
        assert message.startswith("drive.toml: ")
        assert len(message) < 1000
        return message


def fields(mapping: Mapping | str) -> object:
    return mapping if isinstance(mapping, str) else {name: info.fields for name, info in mapping.messages.items()}


def test_a_dbc_that_is_cut_off_is_refused_wherever_a_statement_is_not_whole() -> None:
    whole, dbc, refused = fields(read(DBC)), DBC + OTHERS, 0
    for length in range(len(dbc)):
        found = read(dbc[:length])
        refused += isinstance(found, str)
        if dbc[:length].rstrip()[-1:] not in (";", "") and "SIG_VALTYPE_" in dbc[:length]:
            assert isinstance(found, str) or fields(found) == whole, dbc[length - 40 : length]
    assert refused > 0.9 * len(DBC)


@pytest.mark.parametrize("identifier", [1 << 32, (1 << 32) + 14, 1 << 33, 9_999_999_999])
def test_an_identifier_of_more_than_32_bits_is_no_other_one(identifier: int) -> None:
    refusal = read(
        DBC.replace("BO_ 14 ", f"BO_ {identifier} ").replace("SIG_VALTYPE_ 14 ", f"SIG_VALTYPE_ {identifier} ")
    )
    assert f"expected an identifier of 32 bits, got {identifier}" in str(refusal)


def test_a_dbc_with_bytes_changed_is_read_or_refused_in_one_line() -> None:
    junk = ["", "e999", "9" * 5000, "\0", "\u202e", "m1M", "SG_ ", "BO_ ", "\n", *'90-|:"\\; ']
    for seed in range(600):
        draw, text = random.Random(seed), DBC + OTHERS
        for _ in range(draw.choice((1, 1, 2, 8))):
            at = draw.randrange(len(text))
            text = text[:at] + draw.choice(junk) + text[at + draw.randint(0, 3) :]
        read(text)


def test_what_the_dbc_says_of_other_messages_does_not_matter() -> None:
    unused = 'BO_ 77 Unused: 2 X\n SG_ A : 8|99@1- (1,0) [0|0] "" X\n SG_ B m : 0|16@1- (.5,0) [0|0] "" X\n\nBO_ 1 '
    assert fields(read(DBC.replace("BO_ 1 ", unused) + OTHERS)) == fields(read(DBC))
    spaced = DBC.replace(TORQUE, TORQUE.replace("0|32@1-", "0 | 32 @ 1 -").replace('"Nm" Axis0', '"Nm"  Axis0 , Host'))
    assert fields(read(spaced)) == fields(read(DBC))


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("BO_ 1 ", "BO_ 14 Axis0_Set_Input_Torque: 4 X\n\nBO_ 1 ", "its name is there twice"),
        ("Axis0_Set_Input_Torque: 4", "Axis0_Set_Input_Torque: 64", "expected a classical frame"),
        ("SIG_VALTYPE_ 9 Pos", 'BA_ "VFrameFormat" BO_ 9 14;\nSIG_VALTYPE_ 9 Pos', "expected a classical frame"),
        (TORQUE, TORQUE.replace("|32@", "|134217728@"), "unexpected 'SG_ Input_Torque : 0|134217728"),
        (TORQUE, TORQUE.replace("0|32@", "9999|9999@"), "does not fit"),
        (TORQUE, TORQUE.replace("(1,0)", "(1e999,0)"), "a scale that is finite"),
        (TORQUE, TORQUE.replace("(1,0)", "(1,1e308)"), "can.signals.command: the DBC cannot carry"),
        ("SIG_VALTYPE_ 14 Input_Torque : 1", "SIG_VALTYPE_ 14 Input_Torque 1", "a statement SIG_VALTYPE_ is not"),
        ("SIG_VALTYPE_ 9 Pos", "SG_MUL_VAL_ 14 Input_Torque M 0-4096;\nSIG_VALTYPE_ 9 Pos", "4096 values"),
        ("SIG_VALTYPE_ 9 Pos", "SG_MUL_VAL_ 14 Input_Torque M 0-999999999;\nSIG_VALTYPE_ 9 Pos", "4096 values"),
        ("SIG_VALTYPE_ 9 Pos", "SG_MUL_VAL_ 14 A M 0-99999999999;\nSIG_VALTYPE_ 9 Pos", "SG_MUL_VAL_ is not"),
    ],
)  # fmt: skip
def test_what_of_a_used_message_cannot_be_read_is_named(old: str, new: str, reason: str) -> None:
    assert old in DBC
    found = read(DBC.replace(old, new))
    assert isinstance(found, str)
    assert reason in found


def filled(piece: str, after: str = "") -> Callable[[], str]:
    """The DBC, filled up to the largest size that is read."""
    return lambda: DBC + after + piece * ((MAX_DBC_BYTES - len(DBC) - len(after)) // len(piece))


LARGE: dict[str, Callable[[], str]] = {
    "pages": lambda: DBC.replace(TORQUE, "".join(muxed(MOST_STATEMENTS - 2)) + TORQUE.replace("0|", "16|")).replace(
        "Torque: 4", "Torque: 8"
    ),
    "ranges": lambda: DBC + f"SG_MUL_VAL_ 14 Input_Torque M 1-{MOST_PAGES};\n" * 50_000,
    "signals": lambda: DBC.replace(TORQUE, "".join(muxed(50_000)) + TORQUE),
    "digits": lambda: DBC.replace("BO_ 14 ", f"BO_ {'9' * 1_000_000} "),
    "receivers": lambda: DBC.replace("Nm\" ", f"Nm\" {'X, ' * 1_000_000}"),
    **{
        piece: filled(piece)
        for piece in (" ", "a", '" ', "// ", "\n//\n", ";", "BO_ ", "BO_ 1 A: 8 X\n", "BO_ 1 A: 8 X SG_ ", "NS_ : ")
    },
    "quotes": filled('\\"', 'CM_ "'),
    "messages": filled('BO_ 1000 A: 8 X\n SG_ a : 0|8@1+ (1,0) [0|0] "" X\n\n'),
    "brackets": filled("BO_ 1 A: 8 X SG_ a : 0|1@1+ (1,0) ["),
    "floats": filled("SIG_VALTYPE_ 14 Input_Torque : 1;"),
    "too large": lambda: DBC + " " * MAX_DBC_BYTES,
}  # fmt: skip


def muxed(count: int) -> list[str]:
    """A multiplexor of 16 bits, and signals of a value each."""
    line = ' SG_ S{0} m{0} : 56|8@1+ (1,0) [0|0] "" X\n'
    return [' SG_ Mode M : 0|16@1+ (1,0) [0|0] "" X\n', *(line.format(n) for n in range(count))]


@pytest.mark.parametrize("name", LARGE)
def test_a_large_dbc_takes_little_memory_and_time(name: str) -> None:
    dbc = LARGE[name]()
    before = resource.getrusage(resource.RUSAGE_SELF)
    read(dbc)
    after = resource.getrusage(resource.RUSAGE_SELF)
    assert after.ru_utime - before.ru_utime < 20.0  # of the 4 MiB of a DBC cantools took minutes
    assert after.ru_maxrss - before.ru_maxrss < 256 << 10
