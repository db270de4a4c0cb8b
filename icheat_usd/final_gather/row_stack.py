"""A stack of edits held as sampled rows, as the sums of cache records take it: its keys, its rows, its casters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.edits.bound import BoundEdit, Ends
from icheat_usd.edits.composing import key_shares
from icheat_usd.edits.encodings.rows import BoundRows
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import Blend
from icheat_usd.edits.operations import Level, PairCoefficients
from icheat_usd.final_gather.same_stack import same_casters
from icheat_usd.kernels import row_edits as kernels
from icheat_usd.kernels.row_sites import NEIGHBOURS
from icheat_usd.scene import F32, I32, I64, U8, Bool, SurfacePoints

_BLENDS = {Blend.COMPOSE: kernels.COMPOSE, Blend.OVER: kernels.OVER, Blend.ADD: kernels.ADD}


def is_of_rows(field: EditField) -> bool:
    """Whether some edits are rows, and all others have the same coefficients for all pairs."""
    if field.uses_incident or not any(rows is not None for bound in field.edits for rows in bound.rows):
        return False
    return all(
        bound.level is Level.VIEW or bound.rows[key] is not None or _constants(bound, key) is not None
        for bound in field.edits
        for key in range(bound.n_keys)
    )


def _constants(bound: BoundEdit, key: int) -> PairCoefficients | None:
    if bound.operation is None:
        return bound.baked[key]
    return bound.operation.constants(bound.parameters[key])


class _Key(NamedTuple):
    """A key that acts on pairs."""

    row: int  #: of the field's masks
    edit: int  #: among those that act on pairs
    payload: int  #: among rows, -1 for constants


class RowStack:
    """The edits of a field that act on pairs.

    Attributes
    ----------
    rows : list of BoundRows
        Of all keys that are held so, in order: the payloads.
    first_row : (n_payloads + 1,) int64
        Rows of the payloads before each.
    amounts : (n_edits,) float32
    """

    def __init__(self, field: EditField) -> None:
        self._field = field
        self._edits = [bound for bound in field.edits if bound.level is not Level.VIEW]
        self._keys: list[_Key] = []
        self.rows: list[BoundRows] = []
        row = edit = 0
        for bound in field.edits:
            for rows in bound.rows:
                if bound.level is not Level.VIEW:
                    self._keys.append(_Key(row, edit, -1 if rows is None else len(self.rows)))
                    if rows is not None:
                        self.rows.append(rows)
                row += 1
            edit += bound.level is not Level.VIEW
        self._edit_of_key = np.array([key.edit for key in self._keys], np.int64)
        self._payload_of_key = np.array([key.payload for key in self._keys], np.int32)
        self._key_of_payload = np.flatnonzero(self._payload_of_key >= 0)
        self.first_row = np.cumsum([0, *(len(rows.rows.row_pattern) for rows in self.rows)], dtype=np.int64)
        self.amounts = np.array([bound.edit.amount for bound in self._edits], np.float32)
        self._casters: tuple[SurfacePoints, Ends] | None = None

    @property
    def n_keys(self) -> int:
        return len(self._keys)

    def differs_in_amounts_alone(self, other: RowStack) -> bool:
        """Whether two stacks have the same keys, all of them rows, which act on the same light and casters."""
        if self._keys != other._keys or len(self.rows) < len(self._keys):
            return False
        return self._field.n_rows == other._field.n_rows and all(
            same_casters(a, b) and a.edit.blend is b.edit.blend and np.array_equal(a.groups, b.groups)
            for a, b in zip(self._edits, other._edits, strict=True)
        )

    # Receivers in some of the edits; `acts` is (., n_keys)

    def acting(self, is_in: Bool) -> U8:
        """(n_keys,) of (n_rows,) masks of the field."""
        return is_in[[key.row for key in self._keys]].astype(np.uint8)

    def acting_payloads(self, acts: U8) -> U8:
        """(., n_payloads)."""
        return np.ascontiguousarray(acts[:, self._key_of_payload])

    def has_constants(self, acts: U8) -> Bool:
        """(.,) whether a key that is no row acts."""
        return np.asarray(acts[:, self._payload_of_key < 0].any(axis=1), np.bool_)

    def has_several(self, acts: U8) -> Bool:
        """(.,) whether more than one edit acts."""
        return np.array([len(np.unique(self._edit_of_key[one > 0])) > 1 for one in acts], np.bool_)

    def alone(self, acts: U8) -> I64:
        """(.,) the edit that acts with rows and no other edit beside it, -1 for none."""
        found = np.full(len(acts), -1, np.int64)
        for one, acting in enumerate(acts > 0):
            edits = np.unique(self._edit_of_key[acting])
            if len(edits) == 1 and (self._payload_of_key[acting] >= 0).all():
                found[one] = edits[0]
        return found

    def mixtures(self, receivers: Ends, *, with_amounts: bool = True) -> tuple[I32, F32]:
        """Rows at n receivers and their weights, (n, n_payloads, 4)."""
        n = receivers.masks.shape[1]
        rows = np.empty((n, len(self.rows), NEIGHBOURS), np.int32)
        weights = np.empty(rows.shape, np.float32)
        first = 0
        for bound in self._edits:
            held = [key for key in range(bound.n_keys) if bound.rows[key] is not None]
            located = receivers.located[first : first + len(held)]
            shares = key_shares(bound if with_amounts else bound.at_full_amount, located)
            for key, mixture in zip(held, located, strict=True):
                share = np.asarray(shares[key], np.float32)
                rows[:, first] = mixture.rows
                weights[:, first] = mixture.weights * (share if share.ndim == 0 else share[:, None])
                first += 1
        return rows, weights

    # Casters

    def casters(self, points: SurfacePoints) -> Ends:
        """`EditField.casters` of the points that most is asked of, which are kept."""
        if self._casters is None or self._casters[0] is not points:
            self._casters = points, self._field.casters(points)
        return self._casters[1]

    def varied(self, n_instances: int) -> U8:
        """(n_instances,) 1 where an edit has casters on a part of an instance."""
        found = np.zeros(n_instances, np.uint8)
        for bound in self._edits:
            for casters in bound.casters:
                if not casters.constant_on_instances:
                    found |= casters.on_instances > 0
        return found

    def table(self, casters: list[Ends]) -> kernels.Stack:
        """The edits for some casters, one list after another."""
        constant = np.zeros((self.n_keys, 6), np.float32)
        share = np.zeros(self.n_keys, np.float32)
        q = 0
        for bound in self._edits:
            for key in range(bound.n_keys):
                share[q] = bound.edit.amount * bound.key_weights[key]
                found = None if bound.rows[key] is not None else _constants(bound, key)
                if found is not None:
                    constant[q, :3] = found.scale[0] - np.float32(1)
                    constant[q, 3:] = 0 if found.emission is None else found.emission[0]
                q += 1
        masks = np.concatenate([ends.masks for ends in casters], axis=1)[[key.row for key in self._keys]]
        leaf = np.empty((len(self.rows), masks.shape[1]), np.int32)
        column = np.full((len(self.rows), 6), -1, np.int32)
        for one, rows in enumerate(self.rows):
            located = np.concatenate([ends.located[one] for ends in casters])
            leaf[one] = np.where(located >= 0, rows.cell[np.maximum(located, 0)], -1)
            for kind, name in enumerate(rows.rows.kinds):
                if name in ("delta", "emission"):
                    first = 0 if name == "delta" else 3
                    column[one, first : first + 3] = rows.rows.distinct_columns[3 * kind : 3 * kind + 3]
        is_grey = (column[:, :3] == column[:, :1]).all(axis=1) & (column[:, 3:] < 0).all(axis=1)
        n_cells = np.array([rows.n_cells for rows in self.rows], np.int64)
        return kernels.Stack(
            np.searchsorted(self._edit_of_key, np.arange(len(self._edits) + 1)),
            np.array([_BLENDS[bound.edit.blend] for bound in self._edits]),
            np.stack([bound.groups for bound in self._edits]).astype(np.uint8),
            self._payload_of_key,
            share,
            constant,
            np.ascontiguousarray(masks),
            self._key_of_payload.astype(np.int32),
            leaf,
            column,
            n_cells,
            np.concatenate([[0], np.cumsum((1 + column.max(axis=1)) * n_cells)]),
            bool(is_grey.all() and (constant[:, :3] == constant[:, :1]).all() and not constant[:, 3:].any())
            and all(bound.groups.all() for bound in self._edits),
        )
