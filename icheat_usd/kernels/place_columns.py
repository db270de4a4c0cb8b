"""What is known of places that lights shine on: numbers of the columns of a run of them, and runs of some of them."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import parallel_kernel

RUN = 64  #: successive places that share shadow rays if that is allowed
#: Columns of a run of places, one number for each: origin off the surface, geometric normal, shading normal, albedo
#: over pi; and where a place has a lobe, `specular`, `specular_edge`, alpha (0: no lobe), cosine to the eye, Smith's
#: Lambda of the eye, direction to the eye. The first ones of three, or the one.
ORIGIN, NORMAL, SHADING, TINT = 0, 3, 6, 9
SPECULAR, EDGE, ALPHA, COSINE, LAMBDA, EYE = 12, 15, 18, 19, 20, 21
COLUMNS = 24  #: of a run


@parallel_kernel
def copy_places(columns: np.ndarray, column: np.ndarray, which: np.ndarray, out: np.ndarray) -> None:
    """Copy what is known of some places to runs of their own.

    Parameters
    ----------
    columns : (n_columns, RUN), column : (n_runs, COLUMNS) int32
        Of the places; those of each run.
    which : (n,) int64
    out : (n_some_runs, n_first, RUN), set
        The first columns of these; 0 behind the last place.
    """
    for run in prange(len(out)):
        for j in range(RUN):
            i = run * RUN + j
            if i >= len(which):
                out[run, :, j] = np.float32(0.0)
                continue
            of_run, lane = column[which[i] // RUN], which[i] % RUN
            for c in range(out.shape[1]):
                out[run, c, j] = columns[of_run[c], lane]
