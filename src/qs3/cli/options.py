"""From words of a command line to the library's own settings, by tyro."""

import dataclasses
import functools
import importlib
import types
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

_Settings = TypeVar("_Settings")
Flat = Annotated[_Settings, tyro.conf.arg(name="")]
"""Settings whose fields are options of the verb itself."""

_registry = ConstructorRegistry()


def run_verb(verb: str, place: str, text: str, words: list[str]) -> int:
    """Run the function at ``place``, or one of several, on the words of a command line.

    Where some options choose the defaults of others, the module has ``defaults``: from the words to
    arguments of the function.
    """
    name, _, function_name = place.partition(".")
    module = importlib.import_module(f"qs3.cli.{name}")
    function: Any = getattr(module, function_name)
    how: dict[str, Any] = {"prog": f"qs3 {verb}", "args": words, "registry": _registry}
    if isinstance(function, dict):
        return tyro.extras.subcommand_cli_from_dict(function, description=text, **how)
    if hasattr(module, "defaults"):
        asked = [] if "--tyro-print-completion" in words else words
        function = functools.partial(function, **module.defaults(asked))
    return tyro.cli(function, **how)


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
    """What takes an object or its name (a sensor, a material, ranges) takes names alone here."""
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
