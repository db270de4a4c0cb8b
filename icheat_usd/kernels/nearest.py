"""Nearest of many places with directions, by a grid of their positions."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel


@kernel
def _cell(x, low, size, n):  # type: ignore[no-untyped-def]
    return min(max(np.int64((x - low) / size), 0), n - 1)


@kernel
def sort_into_cells(position, low, size, dims, cell, begin, order):  # type: ignore[no-untyped-def]
    """Count and sort points by cell: those of cell `c` are ``order[begin[c]:begin[c + 1]]``, rows ascending."""
    for i in range(len(position)):
        ix = _cell(position[i, 0], low[0], size, dims[0])
        iy = _cell(position[i, 1], low[1], size, dims[1])
        iz = _cell(position[i, 2], low[2], size, dims[2])
        cell[i] = (iz * dims[1] + iy) * dims[0] + ix
        begin[cell[i] + 1] += 1
    for c in range(len(begin) - 1):
        begin[c + 1] += begin[c]
    place = begin[:-1].copy()
    for i in range(len(position)):
        order[place[cell[i]]] = i
        place[cell[i]] += 1


@parallel_kernel
def nearest_place(position, normal, low, size, dims, begin, order, weight, query, query_normal, out):  # type: ignore[no-untyped-def]
    """Row of the place that is nearest by |p - q|^2 + weight |n - m|^2; the lowest row of several.

    `weight` squared metres make places with another direction further away;
    `low`, `size`, `dims`, `begin` and `order` are what `sort_into_cells` took and made.
    """
    for q in prange(len(query)):
        inside = np.empty(3)
        centre = np.empty(3, np.int64)
        outside = 0.0
        border = np.inf
        for c in range(3):
            inside[c] = min(max(query[q, c], low[c]), low[c] + size * dims[c])
            outside += (query[q, c] - inside[c]) ** 2
            centre[c] = _cell(inside[c], low[c], size, dims[c])
            within = inside[c] - low[c] - size * centre[c]
            border = max(min(border, min(within, size - within)), 0.0)
        best = np.int64(-1)
        best_distance = np.inf
        for ring in range(max(dims[0], max(dims[1], dims[2]))):
            # Rings before this one hold everything nearer than this.
            reach = border + (ring - 1) * size if ring > 0 else 0.0
            if best >= 0 and outside + reach * reach > best_distance:
                break
            for iz in range(max(centre[2] - ring, 0), min(centre[2] + ring + 1, dims[2])):
                for iy in range(max(centre[1] - ring, 0), min(centre[1] + ring + 1, dims[1])):
                    edge = abs(iz - centre[2]) == ring or abs(iy - centre[1]) == ring
                    step = 1 if edge else max(2 * ring, 1)
                    for ix in range(centre[0] - ring, centre[0] + ring + 1, step):
                        if ix < 0 or ix >= dims[0]:
                            continue
                        c = (iz * dims[1] + iy) * dims[0] + ix
                        for k in range(begin[c], begin[c + 1]):
                            i = order[k]
                            distance = 0.0
                            for axis in range(3):
                                distance += (query[q, axis] - position[i, axis]) ** 2
                                distance += weight * (query_normal[q, axis] - normal[i, axis]) ** 2
                            if distance < best_distance or (distance == best_distance and i < best):
                                best = np.int64(i)
                                best_distance = distance
        out[q] = best
