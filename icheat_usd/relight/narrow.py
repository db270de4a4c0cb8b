"""Products with lights of which some were at rest: these exact, and of the transport only what the others need."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from icheat_usd.kernels.assemble import sum_scaled
from icheat_usd.kernels.residuals import add_light_residuals, in_lanes, proportions
from icheat_usd.relight.products import Products
from icheat_usd.scene import F32, I32, I64, Bool
from icheat_usd.transport.packed import LANES

#: Memory of the narrowed tiles: two cores read it in some tenths of a millisecond.
NARROW_BYTES = 6_000_000
#: Cells of a light that are compared in one piece.
_PIECE = 2048


class Rest(NamedTuple):
    """Lights of which some were at rest."""

    light: F32 | None  #: what they are not like then, as `Products.light_of` has it; None: nothing is left
    factors: F32  #: (n_known, 64) how much of each known light there is, in lanes


class Narrow:
    """Keeps the exact product of each light that was at rest, and makes `Products` narrow for lights at rest.

    Products are linear in the light. A light that is as it was at rest needs no
    product, whatever its gain; of one that moves, what is like it was is taken
    from its exact product, channel by channel, and only the rest is multiplied.
    Edited light is multiplied with narrowed rows while all lights rest.
    """

    def __init__(self, products: Products, exact: Products) -> None:
        self._products, self._exact = products, exact
        self._radiance: list[F32] = []  # that the first lights had at rest, (n_gather, 3)
        self._known: F32 = np.zeros((0, len(exact.names) * exact.n_tiles, 4 * LANES), np.float32)  # their products
        self._is_same: list[bool | None] = []  # which lights still have that; None: to be found
        self._moves: list[int] | None = None  # what `forget` was told last
        self._learnt: F32 | None = None  # of the light that is being multiplied: its first tiles
        self._n_tiles = 0  # how many of them there are
        self._n_versions = -1  # that the products are narrow for
        self._is_asked = False  # whether versions had a chance to tell what they need

    def forget(self, moves: list[int] | None = None) -> None:
        """Lights may be others now, but those that have the number in `moves` that they had the last time."""
        if moves is None or self._moves is None:
            self._is_same = []
        else:
            stays = [now == before for now, before in zip(moves, self._moves, strict=False)]
            self._is_same = [same if stay else None for same, stay in zip(self._is_same, stays, strict=False)]
        self._moves, self._learnt = None if moves is None else list(moves), None
        self._products.widen()

    def step(self, radiance: F32, gains: F32, n_versions: int) -> bool:
        """Do a part of the work, for lights (n_lights, n_gather, 3); False when nothing is left.

        Products are narrow for the lights and for the first versions of the edited light. A step is a part of one
        light's exact product, or the choice of the rows.
        """
        is_same = self._compare(radiance)
        if not is_same.all():
            self._learn(radiance, int(np.argmin(is_same)))
            return True
        if self._products.is_narrow and n_versions == self._n_versions:
            return False
        if not self._is_asked:
            self._is_asked = True
            return True
        lights = radiance * np.maximum(gains, np.float32(1))[:, None]
        self._products.narrow(lights, n_versions, NARROW_BYTES)
        self._n_versions, self._is_asked = n_versions, False
        return True

    def versions_changed(self) -> None:
        """Other edits are shown; `step` chooses anew what matters to them."""
        self._n_versions = -1

    def rest_of(self, radiance: F32, gains: F32) -> Rest:
        """What is to be multiplied of lights (n_lights, n_gather, 3) under gains; stays until the next call."""
        is_same = self._compare(radiance)
        factors = np.zeros((len(self._known), 4 * 16), np.float32)
        n = min(len(radiance), len(factors))
        factors[:n] = in_lanes(gains[:n])
        if is_same.all() and len(is_same):
            return Rest(None, factors)
        moved = np.flatnonzero(~is_same).tolist()
        rests = np.empty((len(moved), *radiance.shape[1:]), np.float32)
        rest = np.empty(radiance.shape[1:], np.float32)
        for i, light in enumerate(moved):
            if light < n:
                self._take_known(light, radiance[light], factors, rests[i])
            else:
                rests[i] = radiance[light]
        sum_scaled(rests, np.ascontiguousarray(gains[moved], np.float32), rest)
        return Rest(self._products.light_of(rest), factors)

    def unedited(self, rest: Rest, out: F32, seen: Callable[[], None] | None = None) -> None:
        """Products of the lights that `rest_of` was asked for into ``out[:, : n_tiles]``.

        `seen` is called as by `Products.multiply_all`.
        """
        n_tiles = self._exact.n_tiles
        every = np.arange(n_tiles, dtype=np.int32)

        def add(products: F32, tile: I32) -> None:
            known = self._known
            if len(tile) < n_tiles:
                # An index would give the array another order in memory, and kernels were compiled for this one.
                known = np.take(known, (np.arange(len(products))[:, None] * n_tiles + tile).ravel(), axis=1)
            add_light_residuals(known, rest.factors, len(tile), products.reshape(*products.shape[:2], 4 * LANES))

        if rest.light is not None:
            self._products.multiply_all(rest.light, out, add, seen)
            return
        out[:, :n_tiles] = 0
        add(out, every)
        self._products.see(out, every)
        if seen is not None:
            seen()

    def products_of(self, light: int) -> F32:
        """Exact products of a light as it was at rest, (n_lobes, n_tiles, 64, 4)."""
        found: F32 = self._known[light].reshape(-1, self._exact.n_tiles, LANES, 4)
        return found

    def _take_known(self, light: int, radiance: F32, factors: F32, rest: F32) -> None:
        """Find what of a light is not like it was at rest, `rest`; what is like it goes to `factors`."""
        begin = np.arange(0, len(radiance), _PIECE)
        pieces: I64 = np.stack([0 * begin, begin, np.minimum(begin + _PIECE, len(radiance))], axis=1)
        share = np.zeros((1, 4 * 16), np.float32)
        proportions(pieces, radiance, self._radiance[light], share, rest, np.zeros((1, 4)))
        factors[light] *= share[0]

    def _compare(self, radiance: F32) -> Bool:
        """Which lights are as they were when they were multiplied with the exact rows."""
        del self._is_same[len(radiance) :]
        self._is_same += [None] * (len(radiance) - len(self._is_same))
        for light, same in enumerate(self._is_same):
            if same is None:
                self._is_same[light] = light < len(self._radiance) and _is_same(radiance[light], self._radiance[light])
        return np.array(self._is_same, np.bool_)

    def _learn(self, radiance: F32, light: int) -> None:
        """Multiply some more tiles of exact rows with one light."""
        exact = self._exact
        if self._learnt is None:
            self._learnt, self._n_tiles = exact.room(exact.n_tiles), 0
        if self._n_tiles < exact.n_tiles:
            self._n_tiles = exact.multiply_more(radiance[light], self._n_tiles, self._learnt)
        if self._n_tiles < exact.n_tiles:
            return
        if len(self._radiance) > len(radiance):
            del self._radiance[len(radiance) :]
        if light >= len(self._radiance):
            missing = light + 1 - len(self._radiance)
            self._radiance += [np.zeros_like(radiance[light])] * missing
        grown = np.zeros((len(self._radiance), *self._known.shape[1:]), np.float32)
        n = min(len(grown), len(self._known))
        grown[:n] = self._known[:n]
        grown[light] = self._learnt.reshape(-1, 4 * LANES)
        self._radiance[light], self._known = radiance[light].copy(), grown
        self._learnt = None
        self._is_same[light] = True


def _is_same(now: F32, was: F32) -> bool:
    """Whether two lights are the same, looked at first where that takes little time."""
    return np.array_equal(now[:_PIECE], was[:_PIECE]) and np.array_equal(now, was)
