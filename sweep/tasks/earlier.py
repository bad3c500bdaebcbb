"""What a study asks of the place where some of its results are already."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    from sweep.tasks.calling import Called

KnownThere = TypeVar("KnownThere", covariant=True)


class Earlier(Protocol[KnownThere]):
    """Where results of a study may be had without computing them."""

    taken: dict[int, int]
    """Points of each block that `known` had whole."""

    def known(self, block: int, called: Called) -> KnownThere:
        """What is there of a block, computed as it would be here."""

    def count(self, block: int) -> int:
        """Points of a block of which something is there, if nothing is damaged."""

    def remark(self) -> str:
        """What is not simply taken from there, in words; may be empty."""
