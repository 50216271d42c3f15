"""``cleargs completion``: the script that completes commands in a shell."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class


@click.command(
    epilog="""\b
Examples:
  cleargs completion bash >> ~/.bashrc
  cleargs completion zsh >> ~/.zshrc
  cleargs completion fish > ~/.config/fish/completions/cleargs.fish
"""
)
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def completion(context: click.Context, shell: str) -> None:
    """Print the script for SHELL that completes commands, options, stages, settings and recipes with TAB.

    The completion starts with the next shell.
    """
    root = context.find_root()
    completer = get_completion_class(shell)
    assert completer is not None and root.info_name is not None
    variable = f"_{root.info_name.upper()}_COMPLETE"
    click.echo(completer(root.command, {}, root.info_name, variable).source())
