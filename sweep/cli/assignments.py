"""NAME=VALUE on the command line."""

from __future__ import annotations

import click


def assignments(texts: tuple[str, ...]) -> dict[str, str]:
    """Values by name, as written.

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
                f"{text!r} is not NAME=VALUE, as in range=2km", param_hint="--at"
            )
        found[name.strip()] = value.strip()
    return found
