"""The image of each light alone, at rest: under other gains a frame is their weighted sum, and nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from icheat_usd.kernels.assemble import sum_films
from icheat_usd.relight.direct_sum import DirectSum, SummedLight
from icheat_usd.relight.narrow import Narrow
from icheat_usd.relight.products import Products
from icheat_usd.relight.shared_light import OwnLight, SeenSamples, SharedLight
from icheat_usd.relight.term_tables import TermTables
from icheat_usd.relight.versions import Versions
from icheat_usd.scene import F32, I32, I64

#: Images that take more memory than this are not kept.
MOST_BYTES = 512 * 2**20
#: Products of edited light with exact rows that are made for them at most: some seconds.
MOST_PRODUCTS = 8_192
#: Of the largest light, what is taken for rounding.
ROUNDED = 1e-5
_NOBODY: I32 = np.zeros(0, np.int32)


class AtRest(NamedTuple):
    """What images of lights are made of, once all of it is exact."""

    shared: SharedLight
    narrow: Narrow
    versions: Versions
    terms: TermTables
    products: Products
    exact: Products
    masks: F32  #: of receivers, by row and view sample
    own: OwnLight  #: which view samples have light of their own
    seen: SeenSamples
    light_group: I64  #: (n_lights,)
    n_groups: int


class LightFilms:
    """Keeps the images of lights while nothing but gains changes.

    Only where edited light is linear in the lights, which those that turn hues
    or emit are not. Light that edits take away is held at 0 in each image, so
    where one light would come to less than nothing there are none.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Something else has changed."""
        self._films: F32 | None = None
        self._moved: object = None
        self._work: Iterator[F32 | None] | None = None
        self._is_done = False
        self._sum = DirectSum()

    def hold(self, moved: object) -> bool:
        """Whether there are images; `moved` is a number that grows with everything about lights but their gains."""
        return self._films is not None and moved is not None and moved == self._moved

    def step(self, at_rest: AtRest, radiance: F32, view_direct: F32, moved: object) -> bool:
        """Do a part of the work; False when nothing is left.

        Parameters
        ----------
        radiance : (n_lights, n_gather, 3)
        view_direct : (n_lights, n_view, 3)
        moved
            As for `hold`.
        """
        if moved != self._moved:
            self.forget()
            self._moved = moved
        if self._is_done:
            return False
        if self._work is None:
            self._work = _films_of_lights(at_rest, radiance, view_direct)
        try:
            found = next(self._work)
        except StopIteration:
            found = None
            self._is_done = True
        else:
            self._is_done = found is not None
        self._films = found
        if self._is_done:
            self._work = None
        return not self._is_done

    def add_up(self, gains: F32, seen: SeenSamples, out: F32) -> None:
        """The image under gains (n_lights, 3) into `out` (n_pixels, 3)."""
        assert self._films is not None
        same: Sequence[int] = [0] * len(gains)
        summed = self._sum.now(self._films, gains, same)
        sum_films(tuple(summed), seen.still_pixel, seen.still, out)


def _films_of_lights(at_rest: AtRest, radiance: F32, view_direct: F32) -> Iterator[F32 | None]:
    """None after each step, and at last the images (n_lights, n_pixels, 3), if there can be any."""
    versions, seen = at_rest.versions, at_rest.seen
    n_pixels = len(seen.sample_begin) - 1
    if len(at_rest.own.samples) or not versions.are_linear:
        return
    if 12 * n_pixels * len(radiance) > MOST_BYTES or versions.n_multiplied * len(radiance) > MOST_PRODUCTS:
        return
    films = np.empty((len(radiance), n_pixels, 3), np.float32)
    alone = np.zeros((at_rest.n_groups, *radiance.shape[1:]), np.float32)
    for light, film in enumerate(films):
        alone[:] = 0
        alone[at_rest.light_group[light]] = radiance[light]
        values = versions.room()
        for _ in versions.multiply_alone(alone, at_rest.exact, values):
            yield None
        if not _make_film(at_rest, at_rest.narrow.products_of(light), values, view_direct[light], film):
            return
    yield films


def _make_film(at_rest: AtRest, unedited: F32, values: F32, direct: F32, out: F32) -> bool:
    """The image of one light without what glows by itself; False if edits take more away than there is."""
    shared, soft, seen = at_rest.shared, at_rest.own.added, at_rest.seen
    sums = shared.sums_of(unedited, at_rest.terms.alike, at_rest.versions.pair_of, values)
    own = np.zeros_like(direct)
    if len(soft):
        at_rest.terms.add_soft(soft.astype(np.int64), at_rest.masks, at_rest.products, own, values)
    light = np.empty_like(direct)
    shared.edited(light, sums)
    light[soft] += own[soft]
    if len(light) and light.min() < -ROUNDED * light.max():
        return False
    plain = SummedLight(np.zeros((0, 3), np.float32), direct[None], np.ones((1, 48), np.float32))
    dark = seen._replace(still_pixel=_NOBODY, still=np.zeros((0, 3), np.float32))
    shared.film(OwnLight(_NOBODY, soft, own), plain, dark, out, sums)
    return True
