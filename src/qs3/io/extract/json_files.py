"""JSON files of other people: read with a limit, every value looked at."""

from pathlib import Path
from typing import Any

from qs3.errors import InputError
from qs3.files import read_json


def read_json_file(path: Path, largest: int) -> Any:
    """Read a JSON file of at most ``largest`` bytes.

    Raises:
        InputError: where it is missing, longer, or no JSON.
    """
    path = Path(path)
    if path.is_file() and path.stat().st_size > largest:
        raise InputError(f"{path}: {path.stat().st_size} bytes, more than the {largest} expected")
    try:
        return read_json(path)
    except InputError:
        raise
    except (RecursionError, ValueError) as error:  # nested too deep, a number of 5,000 digits
        raise InputError(f"{path}: not a JSON file ({type(error).__name__})") from error


def json_numbers(value: Any, count: int, name: str) -> list[float]:
    """Return ``count`` numbers out of a value of a JSON file, nested or not.

    Raises:
        InputError: where it is anything else; ``name`` is told.

    Example:
        >>> json_numbers([[1, 2], [3, 4]], 4, "matrix")
        [1.0, 2.0, 3.0, 4.0]
    """
    flat = value if isinstance(value, list) else [value]
    if flat and all(isinstance(row, list) for row in flat):
        flat = [number for row in flat for number in row]
    plain = all(type(number) in (int, float) and abs(number) < 1e300 for number in flat)
    if not plain or len(flat) != count:
        what = "a number" if count == 1 else f"{count} numbers"
        raise InputError(f"{name} must be {what}, not {str(value)[:60]!r}")
    return [float(number) for number in flat]


def whole_number(value: Any, name: str) -> int:
    """Return a whole number of 0 or more out of a value of a JSON file.

    Raises:
        InputError: where it is anything else; ``name`` is told.
    """
    if type(value) is not int or not 0 <= value < 1 << 31:
        raise InputError(f"{name} must be a whole number from 0 up, not {str(value)[:60]!r}")
    return value
