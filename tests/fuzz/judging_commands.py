"""What must hold of `sweep plan` over any text: a plan, or exit code 2 and plain words."""

from __future__ import annotations

import re
from pathlib import Path

from click.testing import CliRunner
from judging import Verdict, kind_of, look_at_mistake
from spoilt_specs import Spoilt

from sweep.cli import main
from sweep.scenes.files import SceneError
from sweep.spec import SpecError, load

DONE, MISTAKE = 0, 2
NO_PLAIN_WORDS = re.compile(r"Traceback|pydantic|Input should|<class|object at 0x|\bnan\b.*nan")


def judge_command(file: Path, spoilt: Spoilt) -> Verdict:
    """`sweep plan` over a spoilt spec, by the way that users go.

    Raises
    ------
    AssertionError
        For a mistake that is not found or not told well, and for a valid spec that is refused.
    Exception
        Whatever else the command raises.
    """
    try:
        file.write_text(spoilt.text, encoding="utf-8", newline="")
    except UnicodeEncodeError:  # a lone surrogate: no file can hold it
        return Verdict(("no text",))
    told = CliRunner().invoke(main, ["plan", str(file)], catch_exceptions=False)
    if told.exit_code == DONE:
        assert not spoilt.wrong, f"taken though {spoilt.change}: {spoilt.place}"
        load(file)
        return Verdict()
    assert told.exit_code == MISTAKE, f"exit code {told.exit_code}"
    assert told.stdout == "", "a plan of what was refused"
    assert not NO_PLAIN_WORDS.search(told.stderr), told.stderr
    return Verdict(_told(file, spoilt, told.stderr))


def _told(file: Path, spoilt: Spoilt, stderr: str) -> tuple[str, ...]:
    """Kinds of what was told, after a look at how."""
    try:
        load(file)
    except SpecError as error:
        for mistake in error.mistakes:
            look_at_mistake(mistake)
            assert mistake.path.split("[")[0] in stderr and mistake.rule in stderr
        if spoilt.wrong and spoilt.place:
            assert any(_about(m.path, spoilt.place) for m in error.mistakes), (
                f"{spoilt.place} ({spoilt.change}) is not named: {error}"
            )
        return tuple(kind_of(mistake) for mistake in error.mistakes)
    except SceneError as error:
        assert error.rule in stderr
        return (error.rule[:50],)
    return (stderr[:60],)  # of a shot that is beyond the model


def _about(path: str, place: str) -> bool:
    """Whether a mistake's path is that of what was changed, or lies around it or in it."""
    return path.startswith(place) or place.startswith(path)
