"""Sampled rows as data: an edit's pair functions at view samples and gather samples, as sparse Haar rows.

The paper's form. Both kinds of samples are places on faces of surfaces, so
that they move with these; nothing here depends on a scene being open.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.edits.model import MaskedSurface
from icheat_usd.kernels import row_coding
from icheat_usd.samples.tree import ClusterTree, TreeShape, build_tree
from icheat_usd.scene import F32, I32, I64, U8, Bool

U16 = NDArray[np.uint16]

#: What rows can hold, in the order of their columns: S - 1, added emission (radiance), offset (1 / m^2, not
#: multiplied by the receiver's albedo).
KINDS = ("delta", "emission", "offset")

#: Deeper trees than this come from no sampler, and would be slow to walk.
MAX_DEPTH = 1024

#: face_uv and position are stored in steps of one over this.
UV_STEPS = 65535


class Places(NamedTuple):
    """Places on control faces of the surfaces of a `SampledRows`."""

    surface: I32  #: (n,) row of `SampledRows.surfaces`
    side: U8  #: (n,) 0 front, 1 back
    face: I32  #: (n,) control face
    face_uv: U16  #: (n, 2) place in it, in 65535ths
    position: U16  #: (n, 3) object space, in 65535ths of the surface's bounds: where to look once faces have changed

    def take(self, which: I64) -> Places:
        return Places._make(np.ascontiguousarray(column[which]) for column in self)


@dataclass(frozen=True, eq=False)
class SampledRows:
    """Rows of Haar coefficients on the cluster tree of the gather samples that the edit concerns.

    Gather samples ("leaves") come in tree order; those of one side of a
    surface are neighbours, and sides that are not listed are not edited. View
    samples ("sites") say which row holds there. Column 3 k + c of the
    coefficients is channel c of ``kinds[k]``; an entry is
    ``numbers[e] * row_step[row]``.
    """

    surfaces: tuple[MaskedSurface, ...]
    bounds: F32  #: (n_surfaces, 2, 3) lowest and highest corner of the places on each, object space
    leaves: Places
    leaf_area: F32  #: (n_leaves,) square metres: the weights of the wavelets
    split_size: I32  #: (n_leaves - 1,) leaves of the left child of each node, in pre-order
    side_surface: I32  #: (n_sides,) sides of surfaces that have leaves,
    side: U8  #: (n_sides,) front or back,
    side_leaves: I32  #: (n_sides, 2) and their first leaf and the one behind the last
    sites: Places
    site_reach: F32  #: (n_sites,) how far a site speaks for its surroundings, object space
    site_row: I32  #: (n_sites,) row, -1: the identity
    row_pattern: I32  #: (n_rows,) coefficients of the row
    row_step: F32  #: (n_rows, 3 len(kinds)) what they are multiplied with
    indptr: I64  #: (n_patterns + 1,) entries of each pattern
    indices: I32  #: (n_entries,) ascending in a pattern: 0 is the mean, 1 + node the node's difference
    numbers: NDArray[np.int8] | NDArray[np.int16]  #: (n_entries, 3 len(kinds))
    kinds: tuple[str, ...]
    epsilon_scale: float = 0.0  #: |S - decoded S| at every site and leaf, for any light: everything lossy is in it
    epsilon_emission: float = 0.0  #: the same of the added emission, radiance
    epsilon_offset: float = 0.0  #: and of the offset, 1 / m^2

    @property
    def n_leaves(self) -> int:
        return len(self.leaf_area)

    @property
    def n_columns(self) -> int:
        return 3 * len(self.kinds)

    @cached_property
    def tree(self) -> ClusterTree:
        """The wavelets' tree."""
        return build_tree(tree_shape(self.split_size, self.n_leaves), self.leaf_area.astype(np.float64), b"rows")

    @cached_property
    def distinct_columns(self) -> I64:
        """(n_columns,) which of the different columns each one is: most edits are grey, or add nothing."""
        found: list[int] = []
        number = np.zeros(self.n_columns, np.int64)
        for column in range(self.n_columns):
            like = [
                k
                for k, other in enumerate(found)
                if np.array_equal(self.row_step[:, column], self.row_step[:, other])
                and np.array_equal(self.numbers[:, column], self.numbers[:, other])
            ]
            number[column] = like[0] if like else len(found)
            if not like:
                found.append(column)
        return number

    @cached_property
    def samples_digest(self) -> str:
        """Names the gather samples and the basis: rows of equal digests can be mixed by coefficients."""
        digest = hashlib.sha256(self.tree.digest.encode())
        for surface in self.surfaces:
            digest.update(f"{surface.instance_id} {surface.part} {surface.topology_digest}\n".encode())
        for column in (*self.leaves, self.side_surface, self.side, self.side_leaves):
            digest.update(np.ascontiguousarray(column).astype(column.dtype.newbyteorder("<")).tobytes())
        return digest.hexdigest()


def tree_shape(split_size: I32 | I64, n_leaves: int) -> TreeShape:
    """Nodes of a tree from how many leaves the left child of each has, in pre-order.

    Raises
    ------
    ValueError
        This describes no tree with that many leaves, or one of more than `MAX_DEPTH` levels.
    """
    lo, mid, hi = (np.empty(len(split_size), np.int32) for _ in range(3))
    depth = row_coding.unfold_splits(np.ascontiguousarray(split_size, np.int64), n_leaves, lo, mid, hi)
    if not 0 <= depth <= MAX_DEPTH:
        raise ValueError(
            f"{len(split_size)} splits are no binary tree of {n_leaves} leaves and at most {MAX_DEPTH} levels"
        )
    return TreeShape(np.arange(n_leaves), lo, mid, hi, np.zeros(0, np.int32))


class Contraction(NamedTuple):
    """A tree with fewer leaves, and how the old one maps to it."""

    split_size: I32
    first: I64  #: (n_new,) first old leaf of each new one
    leaf: I32  #: (n_old,) new leaf, or that before it where the old one was dropped
    node: I32  #: (n_old - 1,) new node, meaningful for nodes that stay


def contract(lo: I32, mid: I32, hi: I32, keep: Bool) -> Contraction:
    """Drop leaves and every node that then has a single child; leaves with `keep` stay, in order."""
    before = np.concatenate([[0], np.cumsum(keep)]).astype(np.int32)
    stays = (before[lo] < before[mid]) & (before[mid] < before[hi])
    return Contraction(
        (before[mid] - before[lo])[stays],
        np.flatnonzero(keep),
        np.maximum(before[1:] - 1, 0).astype(np.int32),
        np.maximum(np.cumsum(stays) - 1, 0).astype(np.int32),
    )


def needed_nodes(tree: ClusterTree, indices: I32) -> Bool:
    """Nodes that hold a coefficient, and all above them."""
    flag = np.zeros(len(tree.left), np.bool_)
    flag[indices[indices > 0] - 1] = True
    row_coding.with_ancestors(tree.left, tree.right, flag)
    return flag


def cell_begins(tree: ClusterTree, needed: Bool) -> Bool:
    """True for the first leaf of every largest subtree on which all rows are constant."""
    begins = np.zeros(tree.n_leaves, np.bool_)
    begins[0] = True
    begins[tree.mid[needed]] = True
    return begins
