"""Print a script that completes commands, options and known names in a shell.

bash: eval "$(apu completion bash)" in ~/.bashrc; zsh: eval "$(apu completion zsh)" in ~/.zshrc;
fish: apu completion fish > ~/.config/fish/completions/apu.fish
"""

from __future__ import annotations

import argparse

NAME = "completion"
HELP = "print a script that completes the command line"
OPTIONS = "shell {bash,zsh,fish} | the shell"


def run(args: argparse.Namespace) -> int:
    """Print the script."""
    from apu_casadi.core.resultformats import FORMATS
    from apu_casadi.unit.exchange import EXCHANGES
    from apu_casadi.unit.integrators import SOLVERS
    from apu_casadi.unit.shippedunits import titles
    from scenarios import commands, registry
    from scenarios.figures import drawnas
    from scenarios.shell import completing

    scenarios = [s.name for s in registry.list_scenarios()]
    known = {
        **dict.fromkeys(("SCENARIO", "--scenario", "--base"), scenarios),
        "--engine": list(titles()),
        "--solver": SOLVERS,
        "--exchange": [e for e in EXCHANGES if " " not in e],
        "--format": list(FORMATS),
        "--figures": drawnas.FORMATS,
        "--start-from": ("balanced", "settled"),
    }
    print(completing.script(args.shell, completing.tree(commands.parser(), known)), end="")
    return 0
