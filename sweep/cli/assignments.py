"""NAME=VALUE on the command line."""

from __future__ import annotations

import click


def assignments(
    texts: tuple[str, ...], option: str = "--at", example: str = "range=2km"
) -> dict[str, str]:
    """Values by name, as written after an option.

    Raises
    ------
    BadParameter
        Where one is not NAME=VALUE.
    """
    found = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name.strip() and equals and value.strip()):
            raise click.BadParameter(
                f"{text!r} is not NAME=VALUE, as in {example}", param_hint=option
            )
        found[name.strip()] = value.strip()
    return found
