"""How large terms of a sample must be so that the smaller ones sum up to an error, or the larger ones are so many."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels._jit import kernel

# Positive numbers are in the order of their bits, and so are those that begin alike.
_SHIFT = 19
_CLASSES = 1 << 31 - _SHIFT


@kernel
def least_term(index, worth, size, n_most, squared_error, share):  # type: ignore[no-untyped-def]
    """The least term that stays.

    Terms are put in classes by how large they are, and only those of the class where it lies in order.

    Parameters
    ----------
    index : (n,) int32, worth : (n,) float32
        A sample of terms: coefficient of each, and what it is worth.
    size : (m,) float32
        Size of each coefficient; no term is negative or infinite.
    n_most
        No more terms stay than about so many, whatever the error; none if it is not above 0.
    squared_error, share : float
        Squares of terms that are left out sum up to no more than either: the error, and the share of all squares.

    Returns
    -------
    float
        Infinite where none stays.
    """
    terms = np.empty(len(index), np.float32)
    for i in range(len(index)):
        terms[i] = worth[i] * size[index[i]]
    bits = terms.view(np.int32)
    squares, counts = np.zeros(_CLASSES), np.zeros(_CLASSES, np.int32)
    for i in range(len(index)):
        squares[bits[i] >> _SHIFT] += np.float64(terms[i]) * np.float64(terms[i])
        counts[bits[i] >> _SHIFT] += 1
    allowed, left_out, n_left = min(squared_error, share * squares.sum()), 0.0, len(index)
    for c in range(_CLASSES):
        if left_out + squares[c] <= allowed or n_left - counts[c] >= n_most:
            left_out += squares[c]
            n_left -= counts[c]
            continue
        for term in np.sort(terms[bits >> _SHIFT == c]):
            left_out += np.float64(term) * np.float64(term)
            if left_out > allowed and n_left <= n_most:
                return term
            n_left -= 1
    return np.float32(np.inf)
