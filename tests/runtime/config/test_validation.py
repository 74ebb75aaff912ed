"""Complaints about a document: the key, what was expected there, what came, and what to do."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from emb_runtime.config.validation import Rules, Table
from emb_runtime.errors import UsageError

RULES = Rules(UsageError, 20, remedy="make it anew")


@pytest.mark.parametrize(
    ("read", "wanted"),
    [
        (lambda t: t.schema(3), "3"),
        (lambda t: t.get("key"), "a value"),
        (lambda t: t.table("key"), "a table"),
        (lambda t: t.tables("key", 1, 4), "a list of 1 to 4 entries"),
        (lambda t: t.numbers("key", 2, 3), "a list of 2 to 3 entries"),
        (lambda t: t.text("key"), "a text"),
        (lambda t: t.text("key", ("this", "that")), "one of this, that"),
        (lambda t: t.text_or_number("key"), "a text or a number"),
        (lambda t: t.integer("key"), "a whole number"),
        (lambda t: t.number("key", lambda v: v > 0.0, "a positive number"), "a positive number"),
        (lambda t: t.number_pair("key"), "[lower, upper]"),
    ],
)
def test_a_key_that_is_missing_is_told_with_what_was_expected_and_what_to_do(
    read: Callable[[Table], object], wanted: str
) -> None:
    with pytest.raises(UsageError) as refused:
        read(Table("file", "", {}, RULES))
    key = "schema" if wanted == "3" else "key"
    assert str(refused.value) == f"file: {key}: missing: expected {wanted}; make it anew"


def test_a_document_of_another_version_is_refused() -> None:
    with pytest.raises(UsageError, match=r"^file: schema: expected 3, got 2$"):
        Table("file", "", {"schema": 2}, RULES).schema(3)
