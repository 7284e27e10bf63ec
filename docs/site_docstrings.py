"""Let the site's reader of docstrings know ``Example:``; it expects ``Examples:``."""

import re
from typing import Any

import griffe

_ONE = re.compile(r"^(\s*)Example:$", re.MULTILINE)


class Examples(griffe.Extension):
    """Turn the heading of a single example into the one that is read as code."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Look at every module, class, function and attribute."""
        if obj.docstring is not None:
            obj.docstring.value = _ONE.sub(r"\1Examples:", obj.docstring.value)
