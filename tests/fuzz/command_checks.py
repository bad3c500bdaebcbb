"""What must hold of `sweep plan` over any text: a plan, or exit code 2 and plain words."""

from __future__ import annotations

import re
from pathlib import Path

from click.testing import CliRunner
from corrupted_specs import CorruptedSpec
from study_checks import Verdict, check_mistake, mistake_kind

from sweep.cli import main
from sweep.scenes.scene_files import SceneError
from sweep.spec import SpecError, load

EXIT_DONE, EXIT_MISTAKE = 0, 2
INTERNAL_WORDS = re.compile(r"Traceback|pydantic|Input should|<class|object at 0x|\bnan\b.*nan")


def check_plan_command(file: Path, corrupted: CorruptedSpec) -> Verdict:
    """`sweep plan` over a spoilt spec, by the way that users go.

    Raises
    ------
    AssertionError
        For a mistake that is not found or not told well, and for a valid spec that is refused.
    Exception
        Whatever else the command raises.
    """
    try:
        file.write_text(corrupted.text, encoding="utf-8", newline="")
    except UnicodeEncodeError:  # a lone surrogate: no file can hold it
        return Verdict(("no text",))
    result = CliRunner().invoke(main, ["plan", str(file)], catch_exceptions=False)
    if result.exit_code == EXIT_DONE:
        assert not corrupted.is_surely_invalid, (
            f"taken though {corrupted.change}: {corrupted.changed_path}"
        )
        load(file)
        return Verdict()
    assert result.exit_code == EXIT_MISTAKE, f"exit code {result.exit_code}"
    assert result.stdout == "", "a plan of what was refused"
    assert not INTERNAL_WORDS.search(result.stderr), result.stderr
    return Verdict(_check_message(file, corrupted, result.stderr))


def _check_message(file: Path, corrupted: CorruptedSpec, stderr: str) -> tuple[str, ...]:
    """Kinds of what was told, after a look at how."""
    try:
        load(file)
    except SpecError as error:
        for mistake in error.mistakes:
            check_mistake(mistake)
            assert mistake.path.split("[")[0] in stderr and mistake.problem in stderr
        if corrupted.is_surely_invalid and corrupted.changed_path:
            assert any(
                _is_related_path(each_mistake.path, corrupted.changed_path)
                for each_mistake in error.mistakes
            ), f"{corrupted.changed_path} ({corrupted.change}) is not named: {error}"
        return tuple(mistake_kind(mistake) for mistake in error.mistakes)
    except SceneError as error:
        assert error.problem in stderr
        return (error.problem[:50],)
    return (stderr[:60],)  # of a shot that is beyond the model


def _is_related_path(mistake_path: str, changed_path: str) -> bool:
    """Tell whether a mistake's path is that of what was changed, or lies around it or in it."""
    return mistake_path.startswith(changed_path) or changed_path.startswith(mistake_path)
