"""What first looks at a light at rest get wrong, taken from those at the light while it moves."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels.known_noise import sum_of_some, take_noise
from icheat_usd.kernels.place_columns import RUN
from icheat_usd.scene import F32, I32

#: Part of all light that counts beside that of a run when its noise is judged.
OF_ALL = 0.1
#: One of so many points tells how bright a look is.
_ASKED = 16


class KnownNoise:
    """Noise of a look with few rays at places whose light is known better: a control variate for looks nearby.

    Parameters
    ----------
    row : (n,)
        Points of the places, in runs of `RUN` that lie together; every point once.
    look, known : (n, 3)
        By point: what few rays say, and what many say.
    least
        Root mean square of a run's noise, beside the light there and `OF_ALL` of that of all, below which it is left.
    smooths
        Whether noise that is new is held down, too; not where many places are added up, of which errors that they
        share are worse than noise.
    """

    def __init__(self, row: I32, look: F32, known: F32, *, least: float, smooths: bool) -> None:
        self._row, self._smooths = row, smooths
        light, seen = (_in_runs(values[row]) for values in (known, look))
        noise = seen - light
        of_light, of_noise = (np.square(values, dtype=np.float64).mean(axis=1) for values in (light, noise))
        of_all = OF_ALL**2 * of_light.sum() / max(len(of_light), 1)
        some = np.flatnonzero(of_noise > least**2 * (of_light + of_all))
        self._runs, self._light, self._noise = some.astype(np.int32), light[some], noise[some]
        self._total = sum_of_some(known, _ASKED)

    def take_from(self, look: F32) -> None:
        """Take from a look near the known one, (n, 3) by point, what noise the two have in common."""
        usual = sum_of_some(look, _ASKED) / self._total if self._total > 0 else 1.0
        take_noise(self._row, self._runs, self._light, self._noise, usual, self._smooths, look)


def _in_runs(values: F32) -> F32:
    """Colours of places (n, 3) as (n_runs, 3 * RUN), channel after channel; 0 behind the last."""
    runs = np.zeros((-(-len(values) // RUN) * RUN, 3), np.float32)
    runs[: len(values)] = values
    return np.ascontiguousarray(runs.reshape(-1, RUN, 3).transpose(0, 2, 1)).reshape(-1, 3 * RUN)
