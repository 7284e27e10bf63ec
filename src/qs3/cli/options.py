"""From words of a command line to the library's own settings, by tyro."""

import dataclasses
import functools
import importlib
import inspect
import re
import types
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructTypeInfo,
)

from qs3.checks import Option
from qs3.errors import QS3Error

_Settings = TypeVar("_Settings")
Flat = Annotated[_Settings, tyro.conf.arg(name="")]
"""Settings whose fields are options of the verb itself."""

_HOME = re.compile(r"\A(--[\w.-]+=)?~(?=/|\Z)")
"""``~`` that a shell leaves as it is: after ``=``, or in quotes."""
REGISTRY = ConstructorRegistry()
"""Rules by which tyro reads our settings."""


def run_verb(verb: str, text: str, words: list[str]) -> int:
    """Run the function of a verb, or one of several, on the words of a command line.

    If some options set the defaults of others, the module has ``defaults``: from the words to
    arguments of the function.
    """
    module = importlib.import_module(f"qs3.cli.{verb}")
    words = [_HOME.sub(lambda found: f"{found[1] or ''}{Path.home()}", word) for word in words]
    function: Any = getattr(module, verb)
    common: dict[str, Any] = {"prog": f"qs3 {verb}", "args": words, "registry": REGISTRY}
    if isinstance(function, dict):
        verbs = {name: _later(each) for name, each in function.items()}
        return tyro.extras.subcommand_cli_from_dict(verbs, description=text, **common)()
    defaults = module.defaults(words) if hasattr(module, "defaults") else {}
    return tyro.cli(functools.partial(_later(function), **defaults), **common)()


def _later(function: Callable[..., int]) -> Callable[..., Callable[[], int]]:
    """Return a function of the same options that returns its call, to run when all is parsed.

    Its help calls positional arguments by their names, and prints no default of None.
    """

    @functools.wraps(function)
    def call(*values: Any, **named: Any) -> Callable[[], int]:
        return functools.partial(function, *values, **named)

    hints = get_type_hints(function, include_extras=True)
    parameters = inspect.signature(function).parameters.values()
    for each in parameters:
        hints[each.name] = _with_help(each.name, hints[each.name], each.default)
    shown = [each.replace(annotation=hints[each.name]) for each in parameters]
    call.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
    call.__annotations__ = hints
    del call.__wrapped__  # whose hints tyro would read
    return call


def _with_help(name: str, kind: Any, default: Any) -> Any:
    """Call a positional argument by its name, and print no default that is None or empty.

    A setting's `qs3.checks.Option` says how else its option looks.
    """
    for mark in getattr(kind, "__metadata__", ()):
        if isinstance(mark, Option):
            form = (
                tyro.conf.Suppress
                if mark.hidden
                else tyro.conf.arg(name=mark.name, metavar=mark.metavar)
            )
            kind = Annotated[kind, form]
    several = get_origin(get_args(kind)[0] if get_origin(kind) is Annotated else kind) is tuple
    has_default = bool(default) if isinstance(default, str | tuple) else default is not None
    positional = tyro.conf.Positional in getattr(kind, "__metadata__", ())
    if positional and "Literal" not in repr(kind):
        metavar = f"{name.upper()} …" if several else name.upper()
        kind = Annotated[kind, tyro.conf.arg(metavar=metavar)]
    if has_default and not (positional and several):
        return kind
    return Annotated[kind, tyro.conf.arg(help_behavior_hint="")]


_open: list[Any] = []
"""Dataclasses that tyro's own rule reads."""


@REGISTRY.struct_rule
def _dataclass(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Read a dataclass by tyro's own rule, and change the help of its fields."""
    if not dataclasses.is_dataclass(info.type) or info.type in _open:
        return None
    _open.append(info.type)
    try:
        spec = ConstructorRegistry.get_struct_spec(info)
    finally:
        _open.pop()
    if not isinstance(spec, StructConstructorSpec):
        return None
    fields = (
        dataclasses.replace(each, type=_with_help(each.name, each.type, each.default))
        for each in spec.fields
    )
    return dataclasses.replace(spec, fields=tuple(fields))


@REGISTRY.primitive_rule
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


@REGISTRY.primitive_rule
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


@REGISTRY.primitive_rule
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
