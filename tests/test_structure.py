"""Laws of reading settings from plain values: strict, one line a fault, and back again."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest

from qs3.errors import InputError
from qs3.structure import first_difference, structure, unstructure


@dataclass(frozen=True)
class Inner:
    share: float
    word: Literal["a", "b", 1] = "a"

    def __post_init__(self) -> None:
        if self.share > 1:
            raise InputError(f"share must be at most 1, not {self.share}")


@dataclass(frozen=True)
class Outer:
    count: int
    inner: Inner
    pair: tuple[int, str] = (1, "x")
    many: tuple[Inner, ...] = ()
    items: Sequence[float] = ()
    table: Mapping[str, Inner] = field(default_factory=dict)
    either: int | str | None = None
    noted: Annotated[tuple[int, ...], "a note"] = ()
    path: Path = Path()
    flag: bool = False
    anything: Any = None


# A value for every field of `Outer`, none its default.
PLAIN = {
    "count": 3,
    "inner": {"share": 0.5, "word": 1},
    "pair": [2, "y"],
    "many": [{"share": 0.25, "word": "b"}],
    "items": [1.0, 2.5],
    "table": {"left": {"share": 1.0, "word": "a"}},
    "either": "text",
    "noted": [1, 2],
    "path": "a/b",
    "flag": True,
    "anything": {"free": [1, None]},
}


def test_there_and_back_is_the_same() -> None:
    value = structure(PLAIN, Outer, "a.json")
    assert value.many[0] == Inner(0.25, "b")
    assert value.path == Path("a/b")
    assert value.noted == (1, 2)
    assert unstructure(value) == PLAIN
    assert json.loads(json.dumps(unstructure(value))) == PLAIN
    assert structure({"a": "b"}, dict[str, str], "a.json") == {"a": "b"}


def test_what_is_left_out_takes_its_default_and_whole_numbers_are_numbers() -> None:
    value = structure({"count": 1, "inner": {"share": 1}}, Outer, "a.json")
    assert value == Outer(1, Inner(1.0))
    assert type(value.inner.share) is float


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coutn": 1}, "field 'coutn' is unknown; did you mean count?"),
        ({"inner": {}}, "field 'inner.share' is missing"),
        ({"count": True}, "field 'count': True is not a whole number"),
        ({"count": 1.0}, "field 'count': 1.0 is not a whole number"),
        ({"flag": 1}, "field 'flag': 1 is not true or false"),
        ({"inner": {"share": "1"}}, "field 'inner.share': '1' is not a number"),
        ({"inner": {"share": 2}}, "field 'inner': share must be at most 1, not 2.0"),
        ({"inner": {"share": 1, "word": True}}, "field 'inner.word': True must be one of a, b, 1"),
        ({"pair": [1]}, "field 'pair': a list of 1, not of 2"),
        ({"noted": [1, "x"]}, "field 'noted[1]': 'x' is not a whole number"),
        ({"items": "12"}, "field 'items': '12' is not a list"),
        ({"table": {"left": {"sha": 1}}}, "field 'table.left.sha' is unknown"),
        ({"either": 1.5}, "field 'either': 1.5 is not a whole number"),
        ({"path": 3}, "field 'path': 3 is not a path"),
        ({"items": [10**5000]}, "field 'items[0]': a huge number is not a number"),
    ],
)
def test_a_fault_is_one_line_that_names_file_and_field(
    change: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError) as caught:
        structure(PLAIN | change, Outer, "a.json")
    assert str(caught.value).startswith(f"a.json: {message}")
    assert "\n" not in str(caught.value)


def test_another_kind_of_value_and_a_fault_of_the_whole_are_reported() -> None:
    with pytest.raises(InputError, match=r"a\.json: 7 is not a table of settings"):
        structure(7, Outer, "a.json")
    with pytest.raises(InputError, match=r"^a\.json: share must be at most 1, not 3\.0$"):
        structure({"share": 3.0}, Inner, "a.json")


@pytest.mark.parametrize(
    ("old", "new", "difference"),
    [
        ({"a": 1}, {"a": 1}, None),
        ({"a": {"c": 1, "b": 1}}, {"a": {"c": 2, "b": 2}}, ("a.b", 1, 2)),
        ({"a": None}, {"a": {"b": 1}}, ("a.b", None, 1)),
        ({"a": {}}, {"a": None}, ("a", {}, None)),
        ({"a": 1}, {}, ("a", 1, None)),
        ({"a": [1]}, {"a": [2]}, ("a", [1], [2])),
    ],
)
def test_the_first_setting_that_differs_is_named(old, new, difference):
    assert first_difference(old, new) == difference
