r"""Messages to users: escaping of unprintable text, and suggestions of commands or Python calls.

Text from stores, specs and file names may contain characters that control a terminal. These are
shown as escape sequences such as `\x1b`. A suggestion is a shell command if the `sweep` command is
running, and a Python call if a program has called the package.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

# Control characters (C0 except tab and line feed, DEL, C1), marks of text direction, invisible
# characters, line separators, surrogates and tags.
_UNPRINTABLE_PATTERN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u061c\u180e\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f"
    "\ufeff\ufff9-\ufffb\ud800-\udfff\U000e0000-\U000e0fff]"
)


def escape_unprintable(text: str) -> str:
    r"""Replace characters that control a terminal or are invisible by escape sequences.

    Tabs and line feeds are kept. Marks of text direction are replaced, because they can make a file
    name look like another.

    Examples
    --------
    >>> print(escape_unprintable("lidar\x1b[2J\u202egnp.exe"))
    lidar\x1b[2J\u202egnp.exe
    """
    return _UNPRINTABLE_PATTERN.sub(_escape_character, text.replace("\r\n", "\n"))


def _escape_character(match: re.Match[str]) -> str:
    """Return the escape sequence of a matched character."""
    code = ord(match[0])
    if code < 0x100:
        return f"\\x{code:02x}"
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def escape_to_one_line(text: object) -> str:
    r"""Return printable text of one line, with line feeds and tabs as escape sequences.

    Examples
    --------
    >>> print(escape_to_one_line("node1\ncomplete"))
    node1\ncomplete
    """
    return escape_unprintable(str(text).replace("\n", "\\n").replace("\t", "\\t"))


def number_with_noun(number: int, thing: str) -> str:
    """Return a number and a noun as text, with a plural s unless the number is 1.

    Examples
    --------
    >>> number_with_noun(1, "shot"), number_with_noun(1200, "shot")
    ('1 shot', '1,200 shots')
    """
    return f"{number:,} {thing}{'' if number == 1 else 's'}"


class EscapedMessageError(Exception):
    """Base class of errors whose messages quote stores, specs and file names.

    Unprintable characters in a message are replaced by escape sequences.
    """

    def __str__(self) -> str:
        return escape_unprintable(super().__str__())


class EscapingStream:
    """Text stream that writes unprintable characters as escape sequences to a wrapped stream.

    It has no attribute `buffer`, so that no output bypasses it. The library rich prints control
    sequences and therefore writes to the wrapped stream, `rich_proxied_file`. Text must be escaped
    before rich prints it.
    """

    def __init__(self, stream: TextIO) -> None:
        self.rich_proxied_file = stream

    def write(self, text: str) -> int:
        """Write text with unprintable characters escaped; return the length of `text`."""
        if not isinstance(text, str):
            raise TypeError(f"a text stream takes str, not {type(text).__name__}")
        self.rich_proxied_file.write(escape_unprintable(text))
        return len(text)

    def writelines(self, lines: Any) -> None:
        """Write several texts, with unprintable characters escaped."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        if name == "buffer":
            raise AttributeError(name)
        return getattr(self.rich_proxied_file, name)


# Suggestions to users

_runs_as_command = False
"""True while the `sweep` command runs; False if a Python program has called the package."""

EXIT_MISTAKE, EXIT_INCOMPLETE = 2, 3
"""Exit codes of the command: for a user's mistake, and for a run that ended before all blocks were
computed."""


class Placeholder(str):
    """Word in a suggestion that the user has to replace."""


SPEC_PLACEHOLDER, STORE_PLACEHOLDER = Placeholder("SPEC"), Placeholder("STORE")
NEW_PLACEHOLDER = Placeholder("NEW")


@contextmanager
def suggest_shell_commands() -> Iterator[None]:
    """Context manager in which suggestions to the user are shell commands, not Python calls."""
    global _runs_as_command
    previous, _runs_as_command = _runs_as_command, True
    try:
        yield
    finally:
        _runs_as_command = previous


def is_run_as_command() -> bool:
    """Return True if this process runs the `sweep` command, False if a Python program."""
    return _runs_as_command


def sweep_shell_command(name: str, *arguments: object, **options: object) -> str:
    """Return a command of `sweep` as typed into a shell, with words quoted if necessary.

    Parameters
    ----------
    name : str
        Name of the command.
    *arguments
        Arguments of the command.
    **options
        Options by their Python names; True for a flag without a value.

    Examples
    --------
    >>> sweep_shell_command("verify", "results/my lidar.zarr", repair=True)
    "sweep verify 'results/my lidar.zarr' --repair"
    """
    words = ["sweep", name, *map(_shell_word, arguments)]
    for option, value in options.items():
        words += (
            [_option_flag(option)] if value is True else [_option_flag(option), _shell_word(value)]
        )
    return " ".join(words)


def _shell_word(value: object) -> str:
    """Return a value as a quoted word of a shell command.

    A word that begins with '-' gets './' in front, so that the shell command takes it as a path.
    """
    word = str(value)
    return shlex.quote(f"./{word}" if word.startswith("-") else word)


def suggested_call(name: str, *arguments: object, **options: object) -> str:
    """Return a shell command to type, or a Python call to make, as text in backquotes.

    The text is a shell command while the `sweep` command runs, else a Python call.

    Parameters
    ----------
    name : str
        Name of the command, and of the package's function: ``resume``.
    *arguments, **options
        Arguments and options, by their Python names.

    Examples
    --------
    >>> suggested_call("resume", "a b.zarr", retry_failed=True)
    "`sweep.resume('a b.zarr', retry_failed=True)`"
    >>> with suggest_shell_commands():
    ...     suggested_call("resume", "a b.zarr", retry_failed=True)
    "`sweep resume 'a b.zarr' --retry-failed`"
    """
    if _runs_as_command:
        return f"`{sweep_shell_command(name, *arguments, **options)}`"
    parts = [_python_literal(argument) for argument in arguments]
    parts += [f"{option}={_python_literal(value)}" for option, value in options.items()]
    return f"`sweep.{name}({', '.join(parts)})`"


def option_text(name: str, value: object = True) -> str:
    """Return an option with its value as text: for a shell command, or as an argument of a call.

    The text is that of a shell command while the `sweep` command runs, else of a Python call.

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
    """Return an option's name as text: ``--store`` in a shell command, ``store=`` in a Python call.

    Examples
    --------
    >>> option_name("store")
    'store='
    """
    return _option_flag(name) if _runs_as_command else f"{name}="


def _option_flag(option: str) -> str:
    """Return the flag of an option: ``--retry-failed`` for ``retry_failed``."""
    return f"--{option.replace('_', '-')}"


def _python_literal(value: object) -> str:
    """Return the Python source text of a value, for an example of a call.

    A placeholder such as STORE becomes the name of a variable, ``store``. Values other than
    booleans, numbers and lists become string literals.
    """
    if isinstance(value, Placeholder):
        return value.lower()
    return repr(value if isinstance(value, bool | int | float | list) else str(value))
