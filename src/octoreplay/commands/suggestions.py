"""Similar names in the errors about unknown commands, options and values of options."""

from __future__ import annotations

from typing import Any

import click

from octoreplay.errors import suggestion


class SuggestingGroup(click.Group):
    """Group of commands that names the most similar command where there is none of a name."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return name, command and further arguments. Raises UsageError for an unknown command."""
        name = args[0]
        if not name.startswith("-") and self.get_command(ctx, name) is None and not ctx.resilient_parsing:
            raise click.UsageError(f"No such command '{name}'{suggestion(name, self.commands)}", ctx)
        return super().resolve_command(ctx, args)


class Choice(click.Choice[str]):
    """One of some words; the error for another word names the most similar one."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the word. Raises BadParameter for another one."""
        if value not in self.choices:
            self.fail(f"'{value}' is not one of {', '.join(self.choices)}{suggestion(str(value), self.choices)}",
                      param, ctx)  # fmt: skip
        return str(value)


def unknown_option(error: click.NoSuchOption) -> click.UsageError:
    """Return the error about an unknown option with the most similar option of the command."""
    known = [] if error.ctx is None else [name for one in error.ctx.command.get_params(error.ctx) for name in
                                          (*one.opts, *one.secondary_opts) if name.startswith("--")]  # fmt: skip
    return click.UsageError(f"No such option '{error.option_name}'{suggestion(error.option_name, known)}", error.ctx)
