"""Error for shots outside the validity of the model."""


class UnsupportedShotError(ValueError):
    """Error for a shot whose parameters, each of them valid, together exceed the model's validity.

    The message is for users. It names the fields, the limit, the value and a remedy.

    Parameters
    ----------
    message : str
        Message for users.
    point_index : int, optional
        Index of the shot among those computed together; None if it is unknown.
    """

    def __init__(self, message: str, point_index: int | None = None) -> None:
        super().__init__(message)
        self.point_index = point_index
        """Index of the shot in the batch that was computed together; None if it is unknown."""
