"""Files of answers that a verb writes, by option: checked before anything is answered."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from qs3.answers.tables import check_table
from qs3.cli.text import notify, show
from qs3.errors import InputError
from qs3.files import resolved, write_text


class AnswerFiles:
    """The files of a verb, and whether its JSON is printed (``--json -``)."""

    def __init__(
        self,
        files: Mapping[str, Path | None],
        inputs: Sequence[Path],
        others: Mapping[str, Path | None] | None = None,
        links: Path | None = None,
    ) -> None:
        """Refuse files that cannot be written, hold something else, or lie in one place.

        Args:
            files: Tables by option.
            inputs: Files that are read.
            others: Further outputs by option.
            links: Folder of links (``--sort-into``), which has to be empty.
        """
        self.is_printed = files.get("json") == Path("-")
        self._files = {
            option: file
            for option, file in files.items()
            if file is not None and not (option == "json" and self.is_printed)
        }
        for option, file in self._files.items():
            if str(file) == "-":
                raise InputError(f"--{option} -: --json alone prints; name a file")
            if file.exists() and any(path.exists() and file.samefile(path) for path in inputs):
                raise InputError(f"--{option} {file}: is one of the clouds to read")
            check_table(file, option, f"--{option}")
        places: dict[Path, str] = {}
        for option, path in (self._files | dict(others or {})).items():
            if path is None:
                continue
            whole = resolved(path)
            if links is not None and resolved(links) in (whole, *whole.parents):
                raise InputError(
                    f"--{option} {path}: lies in --sort-into {links}; name another place"
                )
            if (other := places.setdefault(whole, option)) != option and not path.is_char_device():
                raise InputError(f"--{other} and --{option} name one file, {path}; name two")
        for option, file in self._files.items():
            ending = ".json" if option == "json" else ".csv"
            if file.suffix.lower() in {".csv", ".json"} - {ending}:
                raise InputError(f"--{option} {file}: name a {ending} file")

    @contextlib.contextmanager
    def kept(self, answers: Sequence[object], **texts: Callable[[], str]) -> Iterator[None]:
        """Write what `write` does at the end of a block that appends to ``answers``.

        If Ctrl-C stops it, the files hold the answers so far; those of an earlier call stay.
        """
        try:
            yield
        except KeyboardInterrupt:
            if answers:
                self._files = {name: file for name, file in self._files.items()
                               if not file.exists()}  # fmt: skip
                self.write(**texts)
                notify(*(f"{file}: has what was answered before" for file in self._files.values()))
            raise KeyboardInterrupt("the same command begins anew") from None
        self.write(**texts)

    def write(self, **texts: Callable[[], str]) -> None:
        """Print the JSON if that is wanted, and write each file; ``texts`` make what they hold.

        What is printed does not wait for a file that may fail.
        """
        if self.is_printed:
            show(texts["json"](), end="")
        for option, file in self._files.items():
            write_text(file, texts[option]())
