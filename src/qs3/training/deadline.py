"""A limit on the time of a call, after which it can be taken up again."""

import re
import time

from qs3.errors import InputError, QS3Error


class TimeUpError(QS3Error):
    """The time that a training was given is used up; the same call goes on where it stopped."""


def parse_duration(text: str) -> float:
    """Read hours, minutes and seconds, and return seconds.

    Raises:
        InputError: where the text is not such a time, or is zero.

    Example:
        >>> parse_duration("01:30:00")
        5400.0
    """
    match = re.fullmatch(r"(\d+):([0-5]\d):([0-5]\d)", text, flags=re.ASCII)
    hours, minutes, seconds = (0, 0, 0) if match is None else map(int, match.groups())
    total = 3600.0 * hours + 60.0 * minutes + seconds
    if total == 0:
        raise InputError(f"max-time {text!r}: give hours, minutes and seconds, such as 00:30:00")
    return total


class Deadline:
    """Tells before each epoch whether it will still end in time.

    The first epoch of a call always runs, so that every call gets on.

    Args:
        seconds: Time for the whole call; None sets no limit.
        start: When the call began, by ``time.monotonic()``; now where it is not given.
    """

    def __init__(self, seconds: float | None = None, start: float | None = None) -> None:
        self.start = time.monotonic() if start is None else start
        self.seconds, self.longest = seconds, 0.0

    def passed(self) -> bool:
        """Whether another epoch as long as the longest so far would end too late."""
        if self.seconds is None or self.longest == 0.0:
            return False
        return time.monotonic() - self.start + self.longest > self.seconds

    def note(self, seconds: float) -> None:
        """Note how long an epoch took."""
        self.longest = max(self.longest, seconds, 1e-9)

    def elapsed(self) -> float:
        """Seconds since the call began."""
        return time.monotonic() - self.start
