"""Products with lights at rest: of the transport only what matters to them, and what that loses of each of them."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels.residuals import add_light_residuals
from icheat_usd.relight.products import Products
from icheat_usd.scene import F32
from icheat_usd.transport.packed import LANES

#: Memory of the narrowed tiles: two cores read it in a millisecond or two.
NARROW_BYTES = 20_000_000


class Narrow:
    """Makes `Products` narrow for some lights, in steps, and keeps the residual of each light.

    A narrowed product plus the residuals times the lights' gains equals the product
    with the exact rows, whatever the gains, but for the rounding of light to 16 bits.
    """

    def __init__(self, products: Products, exact: Products) -> None:
        self._products, self._exact = products, exact
        self._known: list[F32] = []  # exact products of the first lights
        self._n_tiles = 0  # that the last of these has
        self._n_versions = -1  # that the products are narrow for
        self._lost: F32 | None = None  # (n_lights, n_lobes * n_tiles, 256)
        self._n_lost = 0  # lights that this is known of

    @property
    def is_ready(self) -> bool:
        """Whether `add` can be used."""
        return self._lost is not None and self._n_lost == len(self._lost)

    def forget(self) -> None:
        """The lights are others now."""
        self._known, self._lost = [], None
        self._products.widen()

    def step(self, radiance: F32, gains: F32, n_versions: int) -> bool:
        """Do a part of the work, for lights (n_lights, n_gather, 3); False when nothing is left.

        Products are narrow for the lights and for the first versions of the edited light. A step is a part of one
        light's exact product, the choice of the rows, or one light's residual.
        """
        if self.is_ready and n_versions == self._n_versions:
            return False
        exact, products = self._exact, self._products
        if len(self._known) < len(radiance) or (self._known and self._n_tiles < exact.n_tiles):
            if not self._known or self._n_tiles == exact.n_tiles:
                self._known.append(exact.room(exact.n_tiles))
                self._n_tiles = 0
            self._n_tiles = exact.multiply_more(radiance[len(self._known) - 1], self._n_tiles, self._known[-1])
        elif self._lost is None or n_versions != self._n_versions:
            lights = radiance * np.maximum(gains, np.float32(1))[:, None]
            products.narrow(lights, n_versions, NARROW_BYTES)
            self._n_versions, self._n_lost = n_versions, 0
            self._lost = np.empty((len(radiance), len(exact.names) * exact.n_tiles, 4 * LANES), np.float32)
        else:
            near = exact.room(exact.n_tiles)
            products.multiply_all(radiance[self._n_lost], near, narrow=True)
            self._lost[self._n_lost] = (self._known[self._n_lost] - near).reshape(-1, 4 * LANES)
            self._n_lost += 1
        return True

    def versions_changed(self) -> None:
        """Other edits are shown; `step` chooses anew what matters to them."""
        self._n_versions = -1

    def add(self, gains: F32, out: F32) -> None:
        """Add what lights under gains lose to products (n_lobes, at least n_tiles, 64, 4)."""
        assert self._lost is not None and self.is_ready
        colors = np.concatenate([gains, np.zeros((len(gains), 1), np.float32)], axis=1)
        factors = np.tile(colors.astype(np.float32), (1, 16))
        flat = out.reshape(len(out), out.shape[1], 4 * LANES)
        add_light_residuals(self._lost, factors, self._exact.n_tiles, flat)
