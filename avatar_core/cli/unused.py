"""Options that a command would ignore: they are refused before anything is computed."""

from __future__ import annotations

import typer

from avatar_core.errors import AvatarError


def refuse(ctx: typer.Context, names: tuple[str, ...], use: str) -> None:
    """Raise AvatarError if an option was given that the command does not use here.

    names : parameters of the command
    use : end of "--unit is ...", e.g. "for files, and phantom is none"
    """
    options = {one.name: max(one.opts, key=len) for one in ctx.command.params}
    given = [options[name] for name in names if is_given(ctx, name)]
    if given:
        verb, them = ("is", "it") if len(given) == 1 else ("are", "them")
        raise AvatarError(f"{', '.join(given)} {verb} {use}; leave {them} out")


def is_given(ctx: typer.Context, name: str) -> bool:
    """Return whether an option stands on the command line, be it with its default value."""
    source = ctx.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def refuse_for_phantom(ctx: typer.Context, surface: str) -> None:
    """Refuse options of files for the built-in liver; a file of a tumour has unit and axes."""
    if surface == "phantom":
        of_tumour = ctx.params.get("tumour") is not None
        names = ("label",) if of_tumour else ("unit", "axes", "label")
        refuse(ctx, names, "for files, and the built-in liver is none")


def refuse_for_built(ctx: typer.Context, surface: str, *names: str) -> None:
    """Refuse options of a build for a vademecum."""
    refuse(ctx, names, f"for a surface, and {surface} is built already")
