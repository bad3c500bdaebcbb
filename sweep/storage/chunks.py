"""Chunks on disk, as Zarr writes them and to the same bytes, at a tenth of the time.

Zarr hands every chunk to an event loop, and its compression and its writing to threads of that:
nearly a millisecond, which for a block of 26 arrays is 2 % of a second's work.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

if TYPE_CHECKING:
    import zarr
    from numcodecs.zstd import Zstd

#: How chunks of every array are compressed.
ZSTD_LEVEL = 1

#: Kinds of numpy's types whose chunks are their values and nothing else.
PLAIN = "biuf"


class Chunked(NamedTuple):
    """How an array is cut into chunks, at hand: Zarr works these out anew whenever asked."""

    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: np.dtype[Any]
    fill: Any

    @classmethod
    def of(cls, array: zarr.Array[Any]) -> Self:
        """That of an array."""
        return cls(array.shape, array.chunks, array.dtype, array.fill_value)

    @property
    def is_plain(self) -> bool:
        """Whether chunks are numbers."""
        return self.dtype.kind in PLAIN

    def place(self, position: tuple[int, ...]) -> tuple[slice, ...]:
        """What of the array a chunk holds; at the far edge that is a part of it."""
        return tuple(
            slice(p * chunk, min((p + 1) * chunk, size))
            for p, chunk, size in zip(position, self.chunks, self.shape, strict=True)
        )

    def encoded(self, values: np.ndarray) -> bytes:
        """Bytes of a chunk: little-endian values in C order, compressed, and the crc32c of that.

        Parameters
        ----------
        values
            Its values; at the array's far edge they fill a part of it.
        """
        from google_crc32c import value as crc32c

        dtype = self.dtype.newbyteorder("<")
        if values.shape == self.chunks:
            chunk = np.ascontiguousarray(values, dtype).reshape(self.chunks)
        else:
            chunk = np.full(self.chunks, self.fill, dtype)
            chunk[tuple(slice(size) for size in values.shape)] = values
        content: bytes = _zstd().encode(chunk)
        return content + int(crc32c(content)).to_bytes(4, "little")


@cache
def _zstd() -> Zstd:
    from numcodecs.zstd import Zstd

    return Zstd(level=ZSTD_LEVEL)
