"""Text of others, written so that a terminal shows it and obeys nothing in it."""

import unicodedata

_OBEYED = {"Cc", "Cf", "Cs", "Zl", "Zp"}
"""Categories of Unicode: control, format (turns of direction), surrogates, breaks of lines."""


def printable(text: str, keep: str = "\n\t") -> str:
    r"""Write control characters, but those to ``keep``, and what cannot be encoded as escapes.

    Example:
        >>> print(printable("a\x1b[2Jb"))
        a\x1b[2Jb
    """
    return "".join(
        letter
        if letter in keep or unicodedata.category(letter) not in _OBEYED
        else letter.encode("unicode_escape").decode()
        for letter in text
    )


def utf8(name: str) -> str:
    r"""Return the name of a file, with bytes that are not UTF-8 as escapes.

    Example:
        >>> print(utf8("st\udcffhl"), utf8("Stühle"))
        st\udcffhl Stühle
    """
    return name.encode("utf-8", errors="backslashreplace").decode("utf-8")
