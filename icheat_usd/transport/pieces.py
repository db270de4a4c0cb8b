"""A long build in pieces that outlive it: what a killed process had done is found again by the next one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar, cast

from icheat_usd.scene import I64
from icheat_usd.transport.rays import MeasuredRows
from icheat_usd.transport.sparse import SparseRows, concatenate_rows

Piece = TypeVar("Piece")

#: Some seconds of work, and some ten megabytes.
_RAYS_PER_PIECE = 1 << 21


class PartStore(Protocol):
    """Keeps parts of one product by name, whole or not at all."""

    def load(self, name: str) -> Any | None:
        """A part, or None where it is missing or damaged."""

    def save(self, name: str, value: Any) -> None: ...


class Pieces:
    """Pieces of work, always the same ones in the same order, each found in a store or made and kept there."""

    def __init__(self, store: PartStore | None = None, rays_per_piece: int = _RAYS_PER_PIECE) -> None:
        self._store, self._rays = store, rays_per_piece
        self._n = 0

    def get(self, make: Callable[[], Piece]) -> Piece:
        """The next piece."""
        name = f"piece-{self._n:05d}"
        self._n += 1
        found = None if self._store is None else self._store.load(name)
        if found is not None:
            return cast(Piece, found)
        made = make()
        if self._store is not None:
            self._store.save(name, made)
        return made

    def measured(self, samples: I64, n_rays: int, make: Callable[[I64], MeasuredRows]) -> MeasuredRows:
        """Rows of some samples, which must not depend on how these are divided.

        As near as `RowBuilder.measure` holds to that: a build that goes on is divided as it was, to the same bits.
        """
        found = self._divided(samples, n_rays, make)
        if len(found) == 1:
            return found[0]
        cells = concatenate_rows([part.cells for part in found], found[0].cells.n_columns)
        return MeasuredRows(cells, n_rays)

    def both(
        self, samples: I64, n_rays: int, make: Callable[[I64], tuple[SparseRows, SparseRows]]
    ) -> tuple[SparseRows, SparseRows]:
        """The same for pairs of rows with the same columns, which they share in memory."""
        found = self._divided(samples, n_rays, make)
        if len(found) == 1:
            return found[0]
        n_columns = found[0][0].n_columns
        base, edge = (concatenate_rows([part[i] for part in found], n_columns) for i in (0, 1))
        return base, SparseRows(base.indptr, base.indices, edge.weights, n_columns)

    def _divided(self, samples: I64, n_rays: int, make: Callable[[I64], Piece]) -> list[Piece]:
        step = max(1, self._rays // max(n_rays, 1))
        parts = [samples[first : first + step] for first in range(0, max(len(samples), 1), step)]
        return [self.get(lambda part=part: make(part)) for part in parts]  # type: ignore[misc]
