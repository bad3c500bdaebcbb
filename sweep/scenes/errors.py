"""What is wrong with a scene's file."""

from __future__ import annotations

from pathlib import Path


class SceneError(Exception):
    """A file that a scene can not be made of.

    Parameters
    ----------
    file : str or Path
        The file.
    rule : str
        The rule broken, as the end of a sentence about the file.
    remedy : str
        What to do about it.
    """

    def __init__(self, file: str | Path, rule: str, remedy: str) -> None:
        super().__init__(f"{file}: {rule}; {remedy}")
        self.file = str(file)
        self.rule = rule
        self.remedy = remedy


def existing(path: str | Path) -> Path:
    """Path of a file that is there.

    Raises
    ------
    SceneError
        Where it is not, or is no plain file: a pipe would be waited for.
    """
    path = Path(path)
    if str(path).startswith("/vsi"):
        raise SceneError(path, "is no file of this machine", "fetch it, and name the file")
    if path.is_dir():
        raise SceneError(path, "is a folder", "name the file in it")
    if not path.exists():
        remedy = "check the path, which is relative to the file that names it"
        if path.parent.is_dir():
            near = sorted(other.name for other in path.parent.glob(f"*{path.suffix}"))[:5]
            remedy += f" (there is: {', '.join(near)})" if near else ""
        raise SceneError(path, "does not exist", remedy)
    if not path.is_file():
        raise SceneError(path, "is a pipe or a device", "name a plain file")
    return path
