"""From words of a command line to the library's own settings, by tyro."""

import contextlib
import dataclasses
import functools
import importlib
import io
import os
import re
import shutil
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from qs3.cli.text import show
from qs3.errors import QS3Error

_Settings = TypeVar("_Settings")
Flat = Annotated[_Settings, tyro.conf.arg(name="")]
"""Settings whose fields are options of the verb itself."""

_registry = ConstructorRegistry()


def run_verb(verb: str, text: str, words: list[str]) -> int:
    """Run the function of a verb, or one of several, on the words of a command line.

    If some options set the defaults of others, the module has ``defaults``: from the words to
    arguments of the function. If it has ``COMMON``, the help shows these options first.
    """
    module = importlib.import_module(f"qs3.cli.{verb}")
    function: Any = getattr(module, verb)
    how: dict[str, Any] = {"prog": f"qs3 {verb}", "args": words, "registry": _registry}
    if isinstance(function, dict):
        verbs = {name: _later(each) for name, each in function.items()}
        return tyro.extras.subcommand_cli_from_dict(verbs, description=text, **how)()
    given = module.defaults(words) if hasattr(module, "defaults") else {}
    call = functools.partial(_later(function), **given)
    if not (hasattr(module, "COMMON") and {"-h", "--help"} & {*words}):
        return tyro.cli(call, **how)()
    # From 130 columns on, tyro puts groups side by side.
    os.environ["COLUMNS"] = str(min(shutil.get_terminal_size().columns, 129))
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        tyro.cli(call, **how)
    show(_common_first(out.getvalue(), module.COMMON), end="")
    return 0


def _common_first(text: str, common: Sequence[str]) -> str:
    """Split the options of a help text into common ones, in this order, and advanced ones."""
    head, rule, block, rest = re.findall(
        r"(.*?\n options *)(\n -+ *\n)(.*?)(\n *\n.*)", text, re.S
    )[0]
    rows = {re.findall(r"--([\w.-]+)", row)[0]: row for row in re.split(r"\n(?=  -)", block)}
    first = [rows.pop(name) for name in ("help", *common)]
    parts = [head, rule, "\n".join(first), "\n\n advanced options", rule]
    return "".join([*parts, "\n".join(rows.values()), rest])


def _later(function: Callable[..., int]) -> Callable[..., Callable[[], int]]:
    """Return a function of the same options that returns its call, to run when all is parsed."""

    @functools.wraps(function)
    def call(*given: Any, **named: Any) -> Callable[[], int]:
        return functools.partial(function, *given, **named)

    return call


@_registry.primitive_rule
def _named(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Refuse an empty word as a path: Python would take it for this folder."""
    if info.type is not Path:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=lambda words: _read_path(words[0]),
        is_instance=lambda value: isinstance(value, Path),
        str_from_instance=lambda value: [str(value)],
    )


def _read_path(word: str) -> Path:
    if not word:
        # No InputError, a ValueError: of those tyro makes a box of its own.
        raise QS3Error('"": an empty path; name a file or a folder, or leave its option out')
    return Path(word)


@_registry.primitive_rule
def _range(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Two numbers as one word, LOW:HIGH."""
    if info.type not in (tuple[float, float], tuple[float, float] | None):
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="LOW:HIGH",
        instance_from_str=lambda words: _read_range(words[0]),
        is_instance=lambda value: value is None or isinstance(value, tuple),
        str_from_instance=lambda value: ["None" if value is None else f"{value[0]:g}:{value[1]:g}"],
    )


def _read_range(word: str) -> tuple[float, float] | None:
    if word == "None":
        return None
    low, _, high = word.partition(":")
    try:
        return float(low), float(high)
    except ValueError:
        raise QS3Error(f"{word!r} is not a range; give LOW:HIGH, such as 0.35:0.8") from None


_LISTED: PrimitiveConstructorSpec[Any] = PrimitiveConstructorSpec(
    nargs=1,
    metavar="NAME[,NAME…]",
    instance_from_str=lambda words: tuple(words[0].split(",")) if "," in words[0] else words[0],
    is_instance=lambda value: isinstance(value, str | tuple),
    str_from_instance=lambda value: [value if isinstance(value, str) else ",".join(value)],
)
"""One name, or several joined by commas."""


@_registry.primitive_rule
def _by_name(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Accept the name alone if a setting takes an object or its name (a sensor, a material)."""
    if get_origin(info.type) not in (Union, types.UnionType):
        return None
    members = get_args(info.type)
    names = [member for member in members if not _is_object(member)]
    if len(names) == len(members):
        return None
    if any(get_origin(name) is tuple for name in names):
        return _LISTED
    kind: Any = Union[tuple(names)]  # noqa: UP007
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kind, info.markers))
    return spec if isinstance(spec, PrimitiveConstructorSpec) else None


def _is_object(kind: Any) -> bool:
    mapping = get_origin(kind) is not None and "Mapping" in str(get_origin(kind))
    protocol = bool(getattr(kind, "_is_protocol", False))
    return dataclasses.is_dataclass(kind) or mapping or protocol
