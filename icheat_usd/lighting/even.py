"""Looks at a rectangle from few places next to it, by rays spread evenly over what they see of it."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels import even_look
from icheat_usd.kernels.clear_light import RECTANGLE
from icheat_usd.lighting.controls import darken
from icheat_usd.lighting.quick import Places, Shadows, Shining
from icheat_usd.scene import F32, I64, SceneSnapshot


def can_look_evenly(snapshot: SceneSnapshot, shining: Shining) -> bool:
    """Whether the one light of a snapshot is a rectangle of one colour that shines alike in all directions."""
    return len(shining.form) > 0 and shining.form[0] == RECTANGLE and snapshot.controls(0).shaping is None


def look_evenly(
    snapshot: SceneSnapshot,
    shadows: Shadows,
    places: Places,
    shining: Shining,
    seed: int,
    n_rays: int,
    sequence: I64,
    out: F32,
) -> None:
    """Light of a one-light snapshot that places reflect, for `can_look_evenly`; `n_rays` of each.

    Parameters
    ----------
    snapshot, shadows, places, shining
        As `quick.direct_at` has them; places in their own order, as `diffuse_places` has them.
    sequence : (n, 2)
        A number that the rays of each place go by, and which of the rays of that number are its first: a place that
        is there twice may have twice as many. Each time it gets a light of its own, so that their mean has what bias
        a ratio of `n_rays` has: half a percent with four.
    out : (n, 3), changed
        Places that look through something keep what they have.
    """
    function, opaque = shadows.opaque.address_of("rtcOccluded16")
    passing = 0 if shadows.passing is None else shadows.passing.address_of("rtcOccluded16")[1]
    even_look.look_evenly(
        function,
        opaque,
        passing,
        shadows.boxes,
        snapshot.lights,
        shining.form,
        np.ascontiguousarray(shining.table[0, 6:9]),
        n_rays,
        seed,
        *places.table,
        sequence,
        float(snapshot.controls(0).diffuse),
        out,
    )
    darken(snapshot, 0, places.instance, out)
