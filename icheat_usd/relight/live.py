"""A view that is edited and relit while someone watches: every change costs what it touches."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from threading import Event
from typing import Any, Protocol

import numpy as np

from icheat_usd.edits.bound import Ends, sent_anew
from icheat_usd.edits.model import EditStack, SurfaceMask
from icheat_usd.errors import EditError, SampleSetMismatch
from icheat_usd.kernels import terms as kernels
from icheat_usd.kernels.assemble import sum_scaled
from icheat_usd.kernels.film_table import FilmTable, film_table
from icheat_usd.kernels.workers import beside
from icheat_usd.relight.alone import AloneSamples
from icheat_usd.relight.amount_films import AmountFilms
from icheat_usd.relight.compiled import Way
from icheat_usd.relight.direct_sum import DirectSum
from icheat_usd.relight.groups import SampleGroups, TermTable, versions_of
from icheat_usd.relight.light_films import ROUNDED, AtRest, LightFilms
from icheat_usd.relight.live_stack import CASTERS, RECEIVERS, Change, LiveStack
from icheat_usd.relight.narrow import Narrow
from icheat_usd.relight.pair_products import PairProducts
from icheat_usd.relight.products import Products
from icheat_usd.relight.relighter import RelitView
from icheat_usd.relight.rest_weights import FitSource, RestWeights
from icheat_usd.relight.shared_light import OwnLight, SharedLight, seen_samples
from icheat_usd.relight.term_tables import TermTables
from icheat_usd.relight.versions import Versions
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, I64, Bool, SceneSnapshot
from icheat_usd.transport import HeldBack, Transport
from icheat_usd.transport.packed import PackedTransport

#: More versions than this, and edits that have no casters in common are kept apart: a version takes a megabyte.
MOST_VERSIONS = 192
#: Products of versions, for each tile, that are made beside those of unedited light.
MOST_BESIDE = 4
#: As many groups and versions that nothing needs any more are kept, since forgetting them takes longer than a frame.
SPARE_GROUPS, SPARE_VERSIONS = 1024, 32


class Lights(Protocol):
    """What is asked of lights; see `relight.lights.LiveLights`."""

    radiance: F32  #: (n_lights, n_gather, 3) at gain 1
    view_direct: F32  #: (n_lights, n_view, 3) at gain 1
    gains: F32  #: (n_lights, 3)

    def direct(self) -> F32: ...
    def refine(self) -> bool: ...


class LiveRelighter:
    """Edits and lights of one view at interactive rates, exact up to what packing loses of the transport.

    Light under edits is the unedited light plus differences: products of the
    transport with edited copies of the casters' radiance that many receivers
    share (`relight.versions`), weighted by the receivers' soft masks. What
    cannot be shared is evaluated pair by pair, from the exact rows. Whatever
    the order of commands, the same state has the same bits.

    Parameters
    ----------
    transport : PackedTransport or Transport
        Exact rows need no packing, and are slower.
    held_back : HeldBack, optional
        Needed by edits that let light pass occluders.
    moving_detail
        Of light not seen before, errors of terms that are not read are divided by this; frames take longer.
    fit_source : FitSource, optional
        With it, weights of interpolation are fitted to lights at rest, see `relight.rest_weights`.
    """

    def __init__(
        self,
        snapshot: SceneSnapshot,
        view: ViewSamples,
        gather: GatherSamples,
        transport: PackedTransport | Transport,
        lights: Lights,
        *,
        held_back: HeldBack | None = None,
        moving_detail: float = 1.0,
        fit_source: FitSource | None = None,
    ) -> None:
        self._fit_source = fit_source
        self._moving_detail = moving_detail
        self.view, self.gather, self.lights, self.held_back = view, gather, lights, held_back
        self._snapshot = snapshot
        self._albedo = np.ascontiguousarray(view.points.albedo)
        self._seen = seen_samples(view)
        self._direct = DirectSum()
        self._base: F32 = np.zeros((view.n, 3), np.float32)
        self._base_stale = True
        self._own: F32 = np.zeros((view.n, 3), np.float32)  # of samples that do not share their light with a group
        self._lights_seen: Any = None
        self._moves_seen: Any = None
        self._light_stale = True
        self._films = LightFilms()
        self._amounts = AmountFilms()
        self._changed_rows: set[int] = set()
        self._stack = LiveStack(snapshot, view, gather, True)
        self.set_transport(transport)

    # Commands ---------------------------------------------------------------------------------------------------------

    def set_transport(self, transport: PackedTransport | Transport) -> None:
        """Go on with other rows of the same view and gather samples, such as finer ones."""
        for lobe in transport.lobes:
            if len(lobe.tint) != self.view.n:
                raise SampleSetMismatch(
                    f"the transport has {len(lobe.tint)} view samples, the view {self.view.n}; build it for this view"
                )
        self.transport = transport = _with_own_weights(transport)
        exact = transport.source if isinstance(transport, PackedTransport) else transport
        if exact is None:
            self._refuse_pairs()
        self._films.forget()
        self._amounts.forget()
        self._products = Products(transport, self.gather.tree, detail=self._moving_detail)
        self._table = _table(self._products)
        self._pair_products = None if exact is None else PairProducts(exact, self.view, self.gather)
        self._exact_products: Products | None = None
        self._n_exact = 0  # tiles of exact rows that the unedited light has
        self._narrow: Narrow | None = None
        self._rest_weights: RestWeights | None = None
        # Where no gather ray meets a surface, there are no rows, and packing loses nothing.
        if exact is not None and exact is not transport and self._products.names:
            self._exact_products = Products(exact, self.gather.tree, self._products.names)
            self._narrow = Narrow(self._products, self._exact_products)
            if self._fit_source is not None and exact.interpolation is not None:
                scene = self._snapshot, self.view, self.gather
                self._rest_weights = RestWeights(self._fit_source, *scene, exact, self._products.names)
        # Uncompressed means exact: what is interpolated is then the transport alone, not what edits make of it.
        self._stack.set_at_records(isinstance(transport, PackedTransport) or transport.interpolation is None)
        self._regroup()

    def set_stack(self, stack: EditStack) -> None:
        """Show another stack; what only differs in amounts and parameters keeps its structure.

        Raises
        ------
        EditError
            An edit cannot be placed on the scene; what was shown before stays.
        """
        self._command(lambda: self._stack.set_stack(stack, self._light_paths()))

    def set_amount(self, edit_path: str, amount: float) -> None:
        """Change how much of one edit is laid over the others; 0 leaves it out, as `mute` does.

        Raises
        ------
        EditError
            There is no such edit, or the amount is not finite.
        """
        self._command(lambda: self._stack.set_amount(edit_path, amount))

    def dab(self, edit_path: str, side: str, mask: SurfaceMask, key: int = 0) -> None:
        """Paint: show another mask of one edit, on the same surfaces; only what its texels touch is found anew.

        Parameters
        ----------
        side : "receivers" or "casters"
        mask
            As it is after the dab.
        key : int
            Which of the edit's painted keys.

        Raises
        ------
        EditError
            There is no such edit, side or key.
        """
        names = {"receivers": RECEIVERS, "casters": CASTERS}
        edit = self._stack.edit(edit_path)
        if side not in names:
            raise EditError(f"{edit_path}: '{side}' cannot be painted; expected one of {', '.join(names)}")
        if not 0 <= key < len(edit.keys) or edit.keys[key].payload is None:
            raise EditError(f"{edit_path}: there is no painted key {key}; the edit has {len(edit.keys)}")
        payload = edit.keys[key].payload
        assert payload is not None
        payload = replace(payload, receiver_mask=mask) if side == "receivers" else replace(payload, caster_mask=mask)
        keys = (*edit.keys[:key], replace(edit.keys[key], payload=payload, digest=""), *edit.keys[key + 1 :])
        self._command(lambda: self._stack.set_edit(replace(edit, keys=keys)))

    def mute(self, edit_path: str, muted: bool = True) -> None:
        """Leave one edit out, or show it again; what shares its samples is found anew, as for a new edit."""
        edit = replace(self._stack.edit(edit_path), enabled=not muted)
        self._command(lambda: self._stack.set_edit(edit))

    def reorder(self, edit_paths: Sequence[str]) -> None:
        """Apply the edits in another order, weakest first.

        Raises
        ------
        EditError
            Not every edit of the stack is named once.
        """
        edits = {edit.path: edit for edit in self.stack.edits}
        if sorted(edit_paths) != sorted(edits):
            raise EditError(f"an order of the stack names each of {', '.join(sorted(edits))} once")
        self.set_stack(replace(self.stack, edits=tuple(edits[path] for path in edit_paths), digest=""))

    @property
    def stack(self) -> EditStack:
        """The stack that is shown."""
        return self._stack.stack

    # Results ----------------------------------------------------------------------------------------------------------

    def frame(self, out: F32 | None = None) -> F32:
        """The image as it is now, (height, width, 3) float32, scene-linear; everything that changed is recomputed.

        Parameters
        ----------
        out : (height, width, 3) float32, optional
            Where to put it.
        """
        shape = (self.view.height, self.view.width, 3)
        image = np.empty(shape, np.float32) if out is None else out
        if image.shape != shape or image.dtype != np.float32:
            raise SampleSetMismatch(f"an image of shape {image.shape} {image.dtype} cannot hold {shape} float32")
        lights = self.lights
        is_flat = image.flags.c_contiguous
        film = image.reshape(-1, 3) if is_flat else np.empty((shape[0] * shape[1], 3), np.float32)
        self._look_at_lights()
        if self._films.hold(self._moves_seen):
            self._films.add_up(lights.gains, self._seen, film)
        elif self._is_between():
            self._amounts.between(self._stack.edit(self._amounts.path).amount, film)
        else:
            self._show_film(film)
        if not is_flat:
            image[:] = film.reshape(shape)
        return image

    def relit(self) -> RelitView:
        """Light of every view sample, in layers."""
        self._update()
        # Held at 0 or above once, at the end, as in the film.
        unedited, edited = (np.maximum(light, np.float32(0)) for light in (self._unedited(), self._edited()))
        return RelitView(np.ascontiguousarray(self.lights.direct(), np.float32), unedited, edited)

    def refine(self, *, fits: bool = True) -> bool:
        """At rest: bring lights to their final quality, then take back what packing lost; False when nothing is left.

        What is reached then depends on lights and stack alone. From then on the unedited light of every light that
        stays where it is follows from its exact product, under all gains; of one that moves, so does what it has in
        common with what it was. Edited light is taken from its exact products in the same way: only what it does not
        have in common with what it was is multiplied, at rest with the part of the packed rows that matters to these
        lights and edits. Versions that are new, or whose casters were painted, are multiplied as a whole. Where edited
        light is a sum over lights, each has an image at last, and under other gains a frame is the sum of these.

        Parameters
        ----------
        fits
            Whether these lights stay, so that fitting weights to them is worth some seconds.
        """
        if self.lights.refine():
            return True
        self._update()
        if self._exact_products is not None and self._narrow is not None:
            if self._narrow.step(self.lights.radiance, self.lights.gains, self._versions.n):
                self._versions.forget_products()
                self._versions.update()
                self._amounts.forget()
                return True
            if self._versions.refine(self._exact_products):
                self._amounts.forget()
                return True
            if self._n_exact < self._exact_products.n_tiles:
                self._n_exact = self._shared.refine_unedited(self._light(), self._exact_products, self._n_exact)
                self._base_stale = True
                return True
            if fits and self._moves_seen is not None and self._fit(self._narrow):
                return True
            self._show(self._mixed_samples)
            return self._films.step(self._at_rest(), self.lights.radiance, self.lights.view_direct, self._moves_seen)
        return False

    def _fit(self, narrow: Narrow) -> bool:
        """Do a part of fitting weights to the lights; False when nothing is left."""
        rest = self._rest_weights
        if rest is None or rest.is_done:
            return False
        is_last = rest.step(narrow.products_of, self.lights.radiance)
        if is_last:
            self._take_weights()
        return True

    def _take_weights(self) -> None:
        """Weights of the interpolation are others."""
        self._table = _table(self._products)
        self._shared.take_weights(self._table)
        self._base_stale = True
        self._amounts.forget()
        self._films.forget()

    # Structure --------------------------------------------------------------------------------------------------------

    def _command(self, act: Callable[[], Change | None]) -> None:
        """Change the stack and what follows from it; after an error all is as it was."""
        before = copy.copy(self._stack)
        change = act()
        if change is not None and change.is_none:
            return
        self._films.forget()
        self._amounts.changed("" if change is None else change.amount_of)
        if change is None:
            try:
                self._regroup()
            except EditError:
                self._stack = before
                self._regroup()
                raise
            return
        if change.before is not None and self._groups.divided:
            # Perhaps they need not be any more.
            self._regroup()
            return
        samples = change.samples
        if change.before is None:
            self._versions.stack_changed(self._stack.compiled, change.rows, change.painted)
            self._changed_rows.update(change.rows)
        else:
            samples = self._restructure(change, change.before)
        if len(samples):
            self._changed_samples.append(samples)
            self._samples_of.clear()
            self._place(samples)

    def _restructure(self, change: Change, before: I64) -> I64:
        """Go on with a stack of other rows; samples, ascending, whose groups are to be found anew."""
        stack = self._stack
        samples = self._groups.restructured(stack.compiled, stack.mask_rows, before, change.gone)
        self._versions.restructured(stack.compiled, before, change.n_before)
        self._terms.restructured(stack)
        self._changed_rows = {row for row, was in enumerate(before.tolist()) if was in self._changed_rows}
        self._samples_of.clear()
        return np.union1d(samples, change.samples) if len(samples) else change.samples

    def _regroup(self, divided: bool = False) -> None:
        """Find everything anew; `divided` as in `relight.groups.group_terms`."""
        stack = self._stack
        if self._pair_products is None:
            self._refuse_pairs()
        else:
            self._pair_products.forget()
        self._versions = Versions(stack.compiled, self._products, self._pair_products, self.gather.area)
        self._changed_rows = set()
        self._light_stale = True
        if self._narrow is not None:
            self._narrow.versions_changed()
        self._group(divided)

    def _group(self, divided: bool) -> None:
        """Find anew which samples share what, of the versions that there are."""
        stack = self._stack
        self._groups = SampleGroups(stack.compiled, stack.mask_rows, self.view.n, divided)
        self._terms = TermTables(stack, self._groups, self._versions)
        self._shared = SharedLight(self._products, self._table)
        self._changed_samples: list[I64] = []
        self._samples_of: dict[frozenset[int], I64] = {}
        self._mixed: Bool = np.zeros(self.view.n, np.bool_)  # not all of their light is shared
        self._soft: Bool = np.zeros(self.view.n, np.bool_)  # but some of it is
        self._alone: Bool = np.zeros(self.view.n, np.bool_)
        self._most_groups = self._most_versions = sys.maxsize
        self._place(np.flatnonzero(self._touched_by(range(len(stack.mask_rows)))))
        self._most_groups = 2 * len(self._groups.terms) + SPARE_GROUPS
        self._most_versions = max(MOST_VERSIONS, self._versions.n + SPARE_VERSIONS)

    def _refuse_pairs(self) -> None:
        """Raise an error if the stack needs exact rows."""
        compiled = self._stack.compiled
        for row in np.flatnonzero((compiled.way == Way.PAIRS) | (compiled.way == Way.ALONE)):
            path = compiled.field.edits[compiled.edit_of[row]].edit.path
            raise EditError(f"{path}: the edit looks at receivers, which needs exact rows of the transport; build them")

    def _place(self, samples: I64) -> None:
        """Find the groups of some samples, and make the versions and products that these need."""
        groups, products = self._groups, self._products
        groups.assign(samples, self._stack.receiver_masks)
        self._terms.arrange()
        if self._is_to_be_divided() != groups.divided:
            self._regroup(divided=not groups.divided)
            return
        if len(groups.terms) > self._most_groups or self._versions.n > self._most_versions:
            self._collect()
            return
        spread = products.interpolation
        needed = np.zeros((self._versions.n, products.n_tiles), np.uint8)
        touched = samples[groups.of_sample[samples] >= 0]
        for terms in self._terms.steps:
            kernels.mark_pairs(
                touched,
                groups.of_sample,
                terms.term_begin,
                terms.term_version,
                products.is_sparse,
                spread.indptr,
                spread.indices,
                needed,
            )
        self._versions.need(needed)
        self._shared.place(samples, groups, np.append(self._terms.shared | self._terms.is_soft, False))
        group = groups.of_sample[samples]
        self._mixed[samples] = ~np.append(self._terms.shared, True)[group]
        self._soft[samples] = np.append(self._terms.is_soft, False)[group]
        self._alone[samples] = np.append(self._terms.alone, False)[group]
        self._mixed_samples = np.flatnonzero(self._mixed)
        whole, soft = (np.flatnonzero(some).astype(np.int32) for some in (self._mixed & ~self._soft, self._soft))
        self._own_light = OwnLight(whole, soft, self._own)
        alone = np.flatnonzero(self._alone)
        self._alone_samples: AloneSamples | None = None
        self._alone_difference: F32 = np.zeros((self.view.n if len(alone) else 0, 3), np.float32)
        if len(alone):
            stack = self._stack
            self._alone_samples = AloneSamples(stack.field, alone, self.view, self.transport, self.held_back)

    def _is_to_be_divided(self) -> bool:
        """Whether the groups need too many versions; depends on what the samples belong to alone."""
        groups = self._groups
        if groups.divided:
            return len(versions_of(groups.undivided[group] for group in groups.live())) > MOST_VERSIONS
        return self._versions.n > MOST_VERSIONS and len(self._terms.versions(groups.live())) > MOST_VERSIONS

    def _collect(self) -> None:
        """Forget groups that no sample belongs to any more, and versions that none of the others needs."""
        changed, shared = self._changed_samples, self._shared
        self._versions.keep(self._terms.versions(self._groups.live()))
        self._group(self._groups.divided)
        self._shared.take_unedited(shared)
        self._changed_samples = changed

    def _touched_by(self, rows: Iterable[int]) -> Bool:
        found = np.zeros(self.view.n, np.bool_)
        for row in rows:
            found |= self._stack.receiver_mask(row) != 0
        return found

    def _changed_places(self) -> I64:
        """Samples to find the light of anew."""
        rows = frozenset(self._changed_rows)
        if rows not in self._samples_of:
            self._samples_of[rows] = np.flatnonzero(self._touched_by(rows))
        samples = self._samples_of[rows]
        if self._changed_samples:
            flags = np.zeros(self.view.n, np.bool_)
            for some in (samples, *self._changed_samples):
                flags[some] = True
            samples = np.flatnonzero(flags)
        return samples

    # Evaluation -------------------------------------------------------------------------------------------------------

    def _at_rest(self) -> AtRest:
        """What images of lights are made of."""
        assert self._narrow is not None and self._exact_products is not None
        stack = self._stack
        return AtRest(
            self._shared,
            self._narrow,
            self._versions,
            self._terms,
            self._products,
            self._exact_products,
            stack.receiver_masks,
            self._own_light,
            self._seen,
            stack.field.light_group,
            stack.field.n_groups,
        )

    def _update(self) -> None:
        self._look_at_lights()
        self._evaluate()

    def _evaluate(self) -> None:
        if not self._light_stale and not self._changed_rows and not self._changed_samples:
            return
        if self._light_stale:
            self._by_group = self._light_by_group()
            self._n_exact = 0
            self._base_stale = True
            self._versions.light_changed(self._by_group)
            self._multiply_light()
            samples = self._mixed_samples
        else:
            self._versions.update()
            samples = self._changed_places()
        self._show(samples)
        self._light_stale = False
        self._changed_rows, self._changed_samples = set(), []

    def _multiply_light(self) -> None:
        """Unedited light, and beside it that of versions, which depends on how bright the image is."""
        is_seen, lights = Event(), self.lights
        multiply: Callable[[], None]
        # What comes before the products has all workers; beside others it would keep these waiting.
        if self._narrow is not None:
            rest = self._narrow.rest_of(lights.radiance, lights.gains)
            multiply = partial(self._shared.set_unedited_near_rest, self._narrow, rest, is_seen.set)
        else:
            light = self._products.light_of(self._light())
            multiply = partial(self._shared.set_unedited, light, is_seen.set)

        def unedited() -> None:
            try:
                multiply()
            finally:
                is_seen.set()

        # Many versions keep all workers busy, and have them from the start.
        if self._versions.has_work and self._versions.n_multiplied <= MOST_BESIDE * self._products.n_tiles:
            # What takes longer is the work, which begins sooner than what is beside it.
            beside(unedited, [partial(self._versions.update, is_seen.wait)])
        else:
            unedited()
            self._versions.update()

    def _show(self, samples: I64) -> None:
        """Add up what groups share, and find the light of some samples that do not share theirs."""
        self._shared.add_up(self._terms.alike, self._versions)
        self._edit(samples)

    def _show_film(self, film: F32) -> None:
        """Evaluate what has changed, and put the image into `film` (n_pixels, 3)."""
        self._evaluate()
        lights = self.lights
        direct = self._direct.now(lights.view_direct, lights.gains, getattr(lights, "light_moves", None))
        self._shared.film(self._own_light, direct, self._seen, film)

    def _edited(self) -> F32:
        """Edited indirect light of all view samples, which may be below 0."""
        edited, own = np.empty_like(self._base), self._own_light
        self._shared.edited(edited)
        edited[own.samples], edited[own.added] = own.light[own.samples], edited[own.added] + own.light[own.added]
        return edited

    def _is_between(self) -> bool:
        """Whether the image lies between two of other amounts; these are made when they are wanted."""
        amounts = self._amounts
        if amounts.are_wanted() and self._rests and self._versions.are_linear and not len(self._own_light.samples):
            shown = self._stack.stack
            images = np.empty((2, self.view.width * self.view.height, 3), np.float32)
            lights = []
            for image, amount in zip(images, (1.0, 0.5), strict=True):
                self.set_amount(amounts.path, amount)
                self._show_film(image)
                lights.append(self._edited())
            self.set_stack(shown)
            # What is held at 0 is not affine.
            least = min(lights[0].min(initial=0), (2 * lights[1] - lights[0]).min(initial=0))
            if least >= -ROUNDED * lights[0].max(initial=0):
                amounts.put(*images)
        return bool(amounts.path) and amounts.hold(self._stack.edit(amounts.path).amount)

    @property
    def _rests(self) -> bool:
        """Whether unedited light is exact."""
        exact = self._exact_products
        return exact is not None and self._n_exact == exact.n_tiles and not self._light_stale

    def _unedited(self) -> F32:
        """Unedited indirect light of all view samples."""
        if self._base_stale:
            self._shared.unedited(self._base)
            self._base_stale = False
        return self._base

    def _look_at_lights(self) -> None:
        revision = getattr(self.lights, "revision", None)
        if self._light_paths() != self._stack.light_paths:
            self._command(lambda: self._stack.set_stack(self._stack.stack, self._light_paths()))
        # Lights that do not tell are taken to have changed.
        self._light_stale |= revision is None or revision != self._lights_seen
        if self._light_stale:
            self._amounts.forget()
        self._lights_seen = revision
        moved = getattr(self.lights, "moves", revision)
        if moved is None or moved != self._moves_seen:
            if self._narrow is not None:
                self._narrow.forget(getattr(self.lights, "light_moves", None))
            self._films.forget()
            if self._rest_weights is not None:
                self._rest_weights.forget()
        self._moves_seen = moved

    def _light_paths(self) -> tuple[str, ...]:
        return tuple(getattr(self.lights, "paths", self._snapshot.light_paths))

    def _light_by_group(self) -> F32:
        """What leaves the cells, by group of lights: (G, n_gather, 3)."""
        field, lights = self._stack.field, self.lights
        out = np.empty((field.n_groups, self.gather.n, 3), np.float32)
        for group in range(field.n_groups):
            some = slice(None) if field.n_groups == 1 else field.light_group == group
            sum_scaled(lights.radiance[some], lights.gains[some], out[group])
        return out

    def _light(self) -> F32:
        """What leaves the cells, (n_gather, 3)."""
        return self._by_group[0] if len(self._by_group) == 1 else self._by_group.sum(axis=0)

    def _edit(self, samples: I64) -> None:
        """Find the light of those of some samples that do not share all of theirs."""
        samples = samples[self._mixed[samples]] if len(self._mixed_samples) else samples[:0]
        is_soft = self._soft[samples]
        if is_soft.any():
            soft = samples if is_soft.all() else samples[is_soft]
            self._terms.add_soft(soft, self._stack.receiver_masks, self._products, self._own)
            samples = samples[~is_soft]
        if not len(samples):
            return
        light = np.take(self._unedited(), samples, axis=0)
        self._add(self._terms.light, samples, self._aggregate_factors(samples), light)
        if self._alone_samples is not None and self._alone[samples].any():
            difference = self._alone_samples.difference(self._stack.field, self.gather, self._by_group)
            self._alone_difference[self._alone] = difference
            light += self._alone_difference[samples]
        self._own[samples] = self._stack.field.finish(light, self._view_ends(samples))

    def _add(self, terms: TermTable, samples: I64, own: F32, out: F32) -> None:
        self._terms.add(terms, samples, self._stack.receiver_masks, own, self._products, self._albedo, out)

    def _aggregate_factors(self, samples: I64) -> F32:
        """What each aggregate makes of the light of its casters: (n, 2 n_aggregates, 3) scale - 1 and emission."""
        stack, terms = self._stack, self._terms
        own = np.zeros((len(samples), 2 * len(terms.aggregates), 3), np.float32)
        for k, row in enumerate(terms.aggregates):
            aggregate = next(found for found in stack.field.aggregates if found.row == row)
            weight = np.float32(stack.compiled.row_amount[row]) * stack.receiver_mask(row)[samples]
            some = np.flatnonzero((weight != 0) & ~self._alone[samples])
            if not len(some):
                continue
            here, mine = samples[some], own[some]
            seen, reach = np.zeros((2, len(some), 3), np.float32)
            self._add(terms.seen[k], here, mine, seen)
            self._add(terms.reach[k], here, mine, reach)
            found = sent_anew(*stack.field.resolve(aggregate, seen), reach)
            assert found.emission is not None
            own[some, 2 * k] = weight[some, None] * (found.scale - np.float32(1))
            own[some, 2 * k + 1] = weight[some, None] * found.emission
        return own

    def _view_ends(self, samples: I64) -> Ends:
        """Receiver masks of what acts on views, which is all that `EditField.finish` looks at."""
        stack = self._stack
        masks = np.zeros((len(stack.mask_rows), len(samples)), np.float32)
        for row in np.flatnonzero(stack.compiled.way == Way.VIEW):
            masks[row] = stack.receiver_mask(row)[samples]
        return Ends(masks, None, ())


def _with_own_weights(transport: PackedTransport | Transport) -> PackedTransport | Transport:
    """The transport with weights of interpolation that nobody else has, as they change at rest."""
    spread = transport.interpolation
    if spread is None:
        return transport
    own = replace(spread, weights=spread.weights.copy())
    if isinstance(transport, PackedTransport):
        source = None if transport.source is None else replace(transport.source, interpolation=own)
        return replace(transport, interpolation=own, source=source)
    return replace(transport, interpolation=own)


def _table(products: Products) -> FilmTable:
    """What view samples are interpolated from."""
    spread, n_view = products.interpolation, products.tints.shape[1]
    if products.is_sparse:
        return film_table(spread.indptr, spread.indices, spread.weights, products.tints)
    row, begin = np.arange(n_view, dtype=np.int32), np.arange(n_view + 1, dtype=np.int64)
    return film_table(begin, row, np.ones(n_view, np.float32), products.tints)
