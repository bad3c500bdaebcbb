"""Shots that are beyond what the model stands for."""


class UnsupportedShot(ValueError):
    """A shot whose parameters, each of them possible, together leave what the model stands for.

    Its text is for users: it names the fields, the limit, what was found and what to do.
    """

    def __init__(self, text: str, point: int | None = None) -> None:
        super().__init__(text)
        self.point = point
        """Number of the shot among those computed together; None where it is not known."""
