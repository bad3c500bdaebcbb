"""Shots that are beyond what the model stands for."""


class UnsupportedShotError(ValueError):
    """A shot whose parameters, each of them possible, together leave what the model stands for.

    Its text is for users: it names the fields, the limit, what was found and what to do.
    """

    def __init__(self, message: str, point_index: int | None = None) -> None:
        super().__init__(message)
        self.point_index = point_index
        """Number of the shot among those computed together; None where it is not known."""
