"""Shots that are beyond what the model stands for."""


class UnsupportedShot(ValueError):
    """A shot whose parameters, each of them possible, together leave what the model stands for.

    Its text is for users: it names the fields, the limit, what was found and what to do.
    """
