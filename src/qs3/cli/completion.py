"""``qs3 completion``: verbs and options for the shell's tab key."""

import contextlib
import importlib
import io
import re
from typing import Annotated, Literal

import tyro

from qs3.cli import ELSEWHERE, VERBS
from qs3.cli.options import run_verb
from qs3.cli.text import show

_SCRIPT = """\
_qs3() {{
  local word=${{COMP_WORDS[COMP_CWORD]}} verb=${{COMP_WORDS[1]}} words=
  if [ "$COMP_CWORD" -eq 1 ]; then
    words="{verbs}"
  else
    case "$verb $COMP_CWORD $word" in
{cases}
    esac
  fi
  COMPREPLY=($(compgen -W "$words" -- "$word"))
}}
complete -o default -F _qs3 qs3
"""
_ZSH = "autoload -U +X compinit && compinit\nautoload -U +X bashcompinit && bashcompinit\n"


def completion(shell: Annotated[Literal["bash", "zsh"], tyro.conf.Positional]) -> int:
    """Print what a shell needs to complete verbs and options.

    Add to ~/.bashrc: source <(qs3 completion bash), or the same with zsh to ~/.zshrc.

    Args:
        shell: The shell.
    """
    cases = []
    for verb in VERBS:
        place = ELSEWHERE.get(verb, f"{verb}.{verb}")
        cases.append(f'      "{verb} "*" -"*) words="{" ".join(_options(verb, place))}" ;;')
        module, _, name = place.partition(".")
        inner = getattr(importlib.import_module(f"qs3.cli.{module}"), name)
        if isinstance(inner, dict):
            cases.append(f'      "{verb} 2 "*) words="{" ".join(inner)}" ;;')
    script = _SCRIPT.format(verbs=" ".join(VERBS), cases="\n".join(cases))
    show(_ZSH + script if shell == "zsh" else script, end="")
    return 0


def _options(verb: str, place: str) -> list[str]:
    """The options of a verb, as tyro's own script for it has them."""
    script = io.StringIO()
    with contextlib.redirect_stdout(script), contextlib.suppress(SystemExit):
        run_verb(verb, place, "", ["--tyro-print-completion", "bash"])
    flags = re.findall(r"'flags': \[([^]]*)\]", script.getvalue())
    return sorted(set(re.findall(r"--[\w.-]+", " ".join(flags))))
