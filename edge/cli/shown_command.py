"""A command line as it was given, without the folders of this machine: for reports that say how to repeat them."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import typer

from edge.cli.source_names import public_name

PROGRAM = "edge"


def shown_command(
    context: typer.Context, *, sources: frozenset[str] = frozenset(), chosen: Mapping[str, Any] | None = None
) -> tuple[str, ...]:
    """The words of a command line that asks for the same again, defaults spelt out.

    Paths and sources are shown by their last parts. What was left to the command (None, a flag not set) stays left
    out, unless ``chosen`` says what it became.

    Args:
        context: of the running command.
        sources: names of the parameters that are source URIs.
        chosen: parameter name -> what the command chose where nothing was given.
    """
    words: list[str] = [PROGRAM, context.info_name or ""]
    for parameter in context.command.params:
        name = parameter.name or ""
        given = context.params.get(name)
        value = (chosen or {}).get(name) if given is None else given
        if value is None or value is False:
            continue
        shown = [] if value is True else [_shown(item, name in sources) for item in _items(value)]
        if parameter.param_type_name == "argument":
            words += shown
        elif value is True:
            words.append(parameter.opts[0])
        else:
            words += [word for item in shown for word in (parameter.opts[0], item)]
    return tuple(words)


def _items(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else [value]


def _shown(value: Any, is_source: bool) -> str:
    if is_source:
        return source_with_geometry(str(value))
    if isinstance(value, Path):
        return value.name or str(value)
    return str(value.value if isinstance(value, Enum) else value)


def source_with_geometry(uri: str) -> str:
    """A source's public name with the name of its geometry file, without which it could not be opened."""
    from runtime.sources.uri import parse_uri

    geometry = parse_uri(uri).options.get("geometry")
    name = public_name(uri)
    if geometry is None:
        return name
    return f"{name}{'&' if parse_uri(name).options else '?'}geometry={Path(geometry).name}"
