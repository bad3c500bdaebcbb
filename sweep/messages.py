r"""Messages to people: text that is safe to show, and commands or Python calls to suggest.

Text from stores, specs and file names may hold characters that a terminal obeys. They are shown as
`\x1b` and the like. A suggestion is a shell command where the `sweep` command runs, and a Python
call where a program has called the package.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

# Escape and other control characters (C0 but tab and line feed, DEL, C1), marks that turn the
# direction of text, invisible characters, separators of lines, surrogates and tags.
_UNPRINTABLE = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u061c\u180e\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f"
    "\ufeff\ufff9-\ufffb\ud800-\udfff\U000e0000-\U000e0fff]"
)


def escape_unprintable(text: str) -> str:
    r"""Text with every character that a terminal would obey, or not show, as an escape sequence.

    Tabs and line feeds stay. Marks that turn the direction of text count too: with them a file
    name can look like another.

    Examples
    --------
    >>> print(escape_unprintable("lidar\x1b[2J\u202egnp.exe"))
    lidar\x1b[2J\u202egnp.exe
    """
    return _UNPRINTABLE.sub(_escape_character, text.replace("\r\n", "\n"))


def _escape_character(match: re.Match[str]) -> str:
    code = ord(match[0])
    if code < 0x100:
        return f"\\x{code:02x}"
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def escape_to_one_line(text: object) -> str:
    r"""Printable text of one line, in which line feeds and tabs are escape sequences too.

    Examples
    --------
    >>> print(escape_to_one_line("node1\ncomplete"))
    node1\ncomplete
    """
    return escape_unprintable(str(text).replace("\n", "\\n").replace("\t", "\\t"))


def counted(number: int, thing: str) -> str:
    """Return a number of things.

    Examples
    --------
    >>> counted(1, "shot"), counted(1200, "shot")
    ('1 shot', '1,200 shots')
    """
    return f"{number:,} {thing}{'' if number == 1 else 's'}"


class PrintableError(Exception):
    """Base of errors whose text quotes stores, specs and file names."""

    def __str__(self) -> str:
        return escape_unprintable(super().__str__())


class PrintableStream:
    """Text stream that makes what is written to it printable.

    It has no `buffer`, so that nothing is written past it. Rich, which makes escape sequences of
    its own, finds the stream itself as `rich_proxied_file`; what it is given to print goes through
    :func:`escape_unprintable` before.
    """

    def __init__(self, stream: TextIO) -> None:
        self.rich_proxied_file = stream

    def write(self, text: str) -> int:
        """Write text."""
        if not isinstance(text, str):
            raise TypeError(f"a text stream takes str, not {type(text).__name__}")
        self.rich_proxied_file.write(escape_unprintable(text))
        return len(text)

    def writelines(self, lines: Any) -> None:
        """Write several texts."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        if name == "buffer":
            raise AttributeError(name)
        return getattr(self.rich_proxied_file, name)


# Suggestions

_runs_as_command = False

EXIT_MISTAKE, EXIT_INCOMPLETE = 2, 3
"""Exit codes of the command for a mistake of the user's, and a run that ended before its blocks."""


class Placeholder(str):
    """Word that stands for what the user has to fill in."""


SPEC_PLACEHOLDER, STORE_PLACEHOLDER = Placeholder("SPEC"), Placeholder("STORE")
NEW_PLACEHOLDER = Placeholder("NEW")


@contextmanager
def suggest_shell_commands() -> Iterator[None]:
    """Context in which suggestions are shell commands: the `sweep` command runs."""
    global _runs_as_command
    previous, _runs_as_command = _runs_as_command, True
    try:
        yield
    finally:
        _runs_as_command = previous


def is_run_as_command() -> bool:
    """Tell whether the `sweep` command runs, whose process ends with it."""
    return _runs_as_command


def shell_command(name: str, *arguments: object, **options: object) -> str:
    r"""Command of `sweep` as one types it into a shell, each word quoted where need be.

    Examples
    --------
    >>> shell_command("verify", "results/my lidar.zarr", repair=True)
    "sweep verify 'results/my lidar.zarr' --repair"
    """
    words = ["sweep", name, *map(_shell_word, arguments)]
    for option, value in options.items():
        words += (
            [_option_flag(option)] if value is True else [_option_flag(option), _shell_word(value)]
        )
    return " ".join(words)


def _shell_word(value: object) -> str:
    """Word that a shell reads as the value, and a command as no option."""
    word = str(value)
    return shlex.quote(f"./{word}" if word.startswith("-") else word)


def suggestion(name: str, *arguments: object, **options: object) -> str:
    """Command to type, or Python call to make, in backquotes.

    Parameters
    ----------
    name : str
        Command, which is also a function of the package: ``resume``.
    *arguments, **options
        Its arguments and options, by the names that Python has for them.

    Examples
    --------
    >>> suggestion("resume", "a b.zarr", retry_failed=True)
    "`sweep.resume('a b.zarr', retry_failed=True)`"
    >>> with suggest_shell_commands():
    ...     suggestion("resume", "a b.zarr", retry_failed=True)
    "`sweep resume 'a b.zarr' --retry-failed`"
    """
    if _runs_as_command:
        return f"`{shell_command(name, *arguments, **options)}`"
    parts = [_python_literal(argument) for argument in arguments]
    parts += [f"{option}={_python_literal(value)}" for option, value in options.items()]
    return f"`sweep.{name}({', '.join(parts)})`"


def option_text(name: str, value: object = True) -> str:
    """Option of the command, or argument of the call, that the user has just made.

    Examples
    --------
    >>> option_text("overwrite"), option_text("allow_code", ["mine"])
    ('overwrite=True', "allow_code=['mine']")
    >>> with suggest_shell_commands():
    ...     option_text("overwrite"), option_text("allow_code", ["mine"])
    ('--overwrite', '--allow-code mine')
    """
    if not _runs_as_command:
        return f"{name}={_python_literal(value)}"
    if value is True:
        return _option_flag(name)
    values = value if isinstance(value, list) else [value]
    return " ".join(f"{_option_flag(name)} {_shell_word(item)}" for item in values)


def option_name(name: str) -> str:
    """Name of an option of the command, or of an argument of the call.

    Examples
    --------
    >>> option_name("store")
    'store='
    """
    return _option_flag(name) if _runs_as_command else f"{name}="


def _option_flag(option: str) -> str:
    return f"--{option.replace('_', '-')}"


def _python_literal(value: object) -> str:
    """Value as Python has it; of what the user has to fill in, its name."""
    if isinstance(value, Placeholder):
        return value.lower()
    return repr(value if isinstance(value, bool | int | float | list) else str(value))
