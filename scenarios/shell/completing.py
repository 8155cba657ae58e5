"""Scripts that complete the command line in bash, zsh and fish, made from the parser."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

__all__ = ["SHELLS", "Node", "script", "tree"]

Names = Mapping[str, Sequence[str]]
"""Values that are known, by the flag or the metavar of what takes them."""


@dataclass
class Node:
    """What may follow a command.

    Args:
        path: the words of the command after ``apu``, with blanks between.
        subs: sub-commands with their help.
        options: by flag, its help.
        values: by flag, what may follow it: names that are known, () for anything.
        words: names that may stand as an argument of its own.
    """

    path: str
    subs: dict[str, str] = field(default_factory=dict)
    options: dict[str, str] = field(default_factory=dict)
    values: dict[str, tuple[str, ...]] = field(default_factory=dict)
    words: tuple[str, ...] = ()


def tree(parser: argparse.ArgumentParser, known: Names, path: str = "") -> list[Node]:
    """Return a parser and all below it.

    Args:
        parser: of the command.
        known: names of scenarios, units, ... by flag or metavar.
        path: the command's words so far.
    """
    node, below = Node(path), []
    for a in parser._actions:
        if isinstance(a, argparse._SubParsersAction):
            node.subs = {c.dest: c.help or "" for c in a._choices_actions}
            for name, sub in a.choices.items():
                below += tree(sub, known, f"{path} {name}".strip())
            continue
        metavar = a.metavar if isinstance(a.metavar, str) else a.dest.upper()
        listed = next((known[k] for k in (*a.option_strings, metavar) if k in known), ())
        words = tuple(str(c) for c in a.choices or listed)
        if not a.option_strings:
            node.words += words
        for flag in a.option_strings:
            node.options[flag] = "" if a.help is None else a.help.replace("%(default)s", "")
            if a.nargs != 0:
                node.values[flag] = words
    return [node, *below]


def script(shell: str, nodes: Sequence[Node]) -> str:
    """Return the script of a shell of :data:`SHELLS`."""
    return SHELLS[shell](nodes)


def _bash(nodes: Sequence[Node]) -> str:
    def case(rows: Sequence[tuple[str, Sequence[str]]]) -> str:
        return "\n".join(
            f'    "{key}") echo "{" ".join(words)}" ;;' for key, words in rows if words
        )

    values = [(f"{n.path} {flag}", w) for n in nodes for flag, w in n.values.items()]
    takes = [f'"{key}"' for key, _ in values]
    return _BASH.format(
        subs=case([(n.path, list(n.subs)) for n in nodes]),
        options=case([(n.path, list(n.options)) for n in nodes]),
        words=case([(n.path, n.words) for n in nodes]),
        values=case(values),
        takes=" | ".join(takes),
    )


_BASH = """\
# completion of apu; in ~/.bashrc: eval "$(apu completion bash)"
_apu_subs() {{ case "$1" in
{subs}
    esac; }}
_apu_options() {{ case "$1" in
{options}
    esac; }}
_apu_arguments() {{ case "$1" in
{words}
    esac; }}
_apu_values() {{ case "$1" in
{values}
    esac; }}
_apu_takes() {{ case "$1" in
    {takes}) return 0 ;;
    esac; return 1; }}
_apu() {{
    local cur="${{COMP_WORDS[COMP_CWORD]}}" before="${{COMP_WORDS[COMP_CWORD-1]}}" at="" i w
    for ((i = 1; i < COMP_CWORD; i++)); do
        w="${{COMP_WORDS[i]}}"
        case " $(_apu_subs "$at") " in *" $w "*) at="${{at:+$at }}$w" ;; esac
    done
    local words
    if _apu_takes "$at $before"; then words=$(_apu_values "$at $before")
    elif [[ $cur == -* ]]; then words=$(_apu_options "$at")
    else words="$(_apu_subs "$at") $(_apu_arguments "$at")"; fi
    COMPREPLY=($(compgen -W "$words" -- "$cur"))
    [[ $cur == -* || -n $(_apu_subs "$at") || ${{#COMPREPLY[@]}} -gt 0 ]] ||
        COMPREPLY=($(compgen -f -- "$cur"))
}}
complete -o filenames -F _apu apu
"""


def _zsh(nodes: Sequence[Node]) -> str:
    text = _bash(nodes).split("\n", 1)[1]
    return (
        '# completion of apu; in ~/.zshrc: eval "$(apu completion zsh)"\n'
        "autoload -Uz compinit bashcompinit && compinit -u && bashcompinit\n" + text
    )


def _fish(nodes: Sequence[Node]) -> str:
    lines = ["# completion of apu; apu completion fish > ~/.config/fish/completions/apu.fish"]
    subs = "\n".join(
        f'        case "{n.path}"\n            echo {" ".join(n.subs)}' for n in nodes if n.subs
    )
    lines.append(_FISH.format(subs=subs))
    for n in nodes:
        at = f"complete -c apu -n '__apu_at \"{n.path}\"'"
        lines += [f"{at} -f -a {name} -d {_quoted(text)}" for name, text in n.subs.items()]
        lines += [f"{at} -a '{' '.join(n.words)}'"] if n.words else []
        for flag, text in n.options.items():
            what = f"-l {flag[2:]}" if flag.startswith("--") else f"-s {flag[1:]}"
            words, takes = n.values.get(flag, ()), flag in n.values
            more = f" -x -a '{' '.join(words)}'" if words else " -r" if takes else ""
            lines.append(f"{at} {what}{more} -d {_quoted(text)}")
    return "\n".join(lines) + "\n"


_FISH = """\
function __apu_subs
    switch "$argv[1]"
{subs}
    end
end
function __apu_at
    set -l at ""
    for w in (commandline -opc)[2..]
        if contains -- $w (string split " " -- (__apu_subs "$at"))
            set at (string trim -- "$at $w")
        end
    end
    test "$at" = "$argv[1]"
end"""


def _quoted(text: str) -> str:
    first = " ".join(text.split()).split(";")[0][:70]
    return "'" + first.replace("\\", "\\\\").replace("'", "\\'") + "'"


SHELLS = {"bash": _bash, "zsh": _zsh, "fish": _fish}
"""The shells, and what makes their scripts."""
