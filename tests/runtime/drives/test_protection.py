"""Checksums of drives' messages against AUTOSAR's library, and published check values."""

from __future__ import annotations

import random

import e2e

from emb_runtime.drives.signals import Field, Protection, crc8_h2f


def field(name: str, start: int, length: int, big_endian: bool = False) -> Field:
    return Field(name, start, length, big_endian, False, False, 1.0, 0.0)


def test_the_crc_has_its_published_check_value() -> None:
    assert crc8_h2f(b"123456789") == 0xDF


def test_profiles_1_2_and_5_agree_with_the_reference_library() -> None:
    for seed in range(40):
        draw = random.Random(seed)
        data_id = draw.randrange(1 << 16)
        ids = tuple(draw.randrange(256) for _ in range(16))
        body = bytes(draw.randrange(256) for _ in range(8))

        first = bytearray(body)
        first[1] = first[1] & 0xF0 | draw.randrange(14)
        e2e.p01.e2e_p01_protect(first, data_id, data_id_mode=e2e.p01.E2E_P01_DATAID_BOTH, increment_counter=False)
        profile1 = Protection("profile1", field("c", 0, 8), field("n", 8, 4), 15, (data_id,))
        assert profile1.checksum_of(bytes(first)) == first[0]
        assert profile1.fault(bytes(first)) == ""

        second = bytearray(body)
        e2e.p02.e2e_p02_protect(second, bytes(ids), increment_counter=False)
        profile2 = Protection("profile2", field("c", 0, 8), field("n", 8, 4), 16, ids)
        assert profile2.checksum_of(bytes(second)) == second[0]

        fifth = bytearray(body)
        e2e.p05.e2e_p05_protect(fifth, data_id, increment_counter=False)
        profile5 = Protection("profile5", field("c", 0, 16), field("n", 16, 8), 256, (data_id,))
        assert profile5.checksum_of(bytes(fifth)).to_bytes(2, "little") == bytes(fifth[:2])
        fifth[3] ^= 1
        assert profile5.fault(bytes(fifth)) == "wrong checksum"


def test_xor_and_sum_are_those_of_all_other_bytes_and_the_start_value() -> None:
    data = bytes((0, 1, 2, 3, 250, 5, 6, 99))
    last = field("c", 63, 8, big_endian=True)
    assert Protection("xor", last, start=7).checksum_of(data) == 7 ^ 0 ^ 1 ^ 2 ^ 3 ^ 250 ^ 5 ^ 6
    assert Protection("sum", last, start=7).checksum_of(data) == (7 + 0 + 1 + 2 + 3 + 250 + 5 + 6) % 256
