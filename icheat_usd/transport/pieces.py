"""A long build in pieces that outlive it: what a killed process had done is found again by the next one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Protocol, TypeVar, cast

from icheat_usd.kernels.workers import overlapping
from icheat_usd.progress import Progress, silent
from icheat_usd.scene import I64
from icheat_usd.transport.rays import MeasuredRows
from icheat_usd.transport.sparse import SparseRows, concatenate_rows

Piece = TypeVar("Piece")

#: Some tenths of a second of one worker, and some megabytes.
_RAYS_PER_PIECE = 1 << 19


class PartStore(Protocol):
    """Keeps parts of one product by name, whole or not at all."""

    def load(self, name: str) -> Any | None:
        """A part, or None where it is missing or damaged."""

    def save(self, name: str, value: Any) -> None: ...


class Pieces:
    """Pieces of work, always the same ones in the same order, each found in a store or made and kept there.

    They are made by `overlapping`, so none may depend on another.
    """

    def __init__(
        self, store: PartStore | None = None, progress: Progress = silent, rays_per_piece: int = _RAYS_PER_PIECE
    ) -> None:
        self._store, self._progress, self._rays = store, progress, rays_per_piece
        self._n = 0

    def each(self, make: Callable[[I64], Piece], parts: list[I64], step: str) -> Iterator[Piece]:
        """The next pieces, made of some samples each. All are to be asked for."""
        makers = [partial(self._one, f"piece-{self._n + i:05d}", partial(make, part)) for i, part in enumerate(parts)]
        self._n += len(parts)
        self._progress(step, 0.0)
        for done, piece in enumerate(overlapping(makers), 1):
            yield piece
            self._progress(step, done / len(parts))

    def _one(self, name: str, make: Callable[[], Piece]) -> Piece:
        found = None if self._store is None else self._store.load(name)
        if found is not None:
            return cast(Piece, found)
        made = make()
        if self._store is not None:
            self._store.save(name, made)
        return made

    def measured(self, make: Callable[[I64], MeasuredRows], samples: I64, n_rays: int, step: str) -> MeasuredRows:
        """Rows of some samples, which must not depend on how these are divided.

        As near as `RowBuilder.measure` holds to that: a build that goes on is divided as it was, to the same bits.
        """
        found = list(self.each(make, self._divided(samples, n_rays), step))
        if len(found) == 1:
            return found[0]
        cells = concatenate_rows([part.cells for part in found], found[0].cells.n_columns)
        return MeasuredRows(cells, n_rays)

    def both(
        self, make: Callable[[I64], tuple[SparseRows, SparseRows]], samples: I64, n_rays: int, step: str
    ) -> tuple[SparseRows, SparseRows]:
        """The same for pairs of rows with the same columns, which they share in memory."""
        found = list(self.each(make, self._divided(samples, n_rays), step))
        if len(found) == 1:
            return found[0]
        n_columns = found[0][0].n_columns
        base, edge = (concatenate_rows([part[i] for part in found], n_columns) for i in (0, 1))
        return base, SparseRows(base.indptr, base.indices, edge.weights, n_columns)

    def _divided(self, samples: I64, n_rays: int) -> list[I64]:
        step = max(1, self._rays // max(n_rays, 1))
        return [samples[first : first + step] for first in range(0, max(len(samples), 1), step)]
