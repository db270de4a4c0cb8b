"""The lights of one view while they are being changed: what each brings to gather cells and view samples."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from icheat_usd.lighting.change import (
    LightError,
    LightImages,
    changed_light,
    checked_numbers,
    join_lights,
    new_light,
    one_light,
)
from icheat_usd.lighting.domes import BinnedSky
from icheat_usd.relight.light_work import (
    AnyLight,
    Following,
    KnownLight,
    MovingLight,
    SparseView,
    Surroundings,
    build_surroundings,
)
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, LightKind, SceneSnapshot
from icheat_usd.steps import Steps
from icheat_usd.tracing import Tracer
from icheat_usd.transport import Bounces, CellLight, Transport, sum_lights
from icheat_usd.transport.influence import influence_on_view

# Light of all cells alike, in means of a light that rests, that rows of bounces on the move are made for: what is dark
# now may be lit once a light moves. As much as all lights have, where these are more.
_ALIKE = 4.0


@dataclass
class _Light:
    """One light, and the work on it that is left: None when it has its final quality."""

    alone: SceneSnapshot
    work: AnyLight | MovingLight | KnownLight | None = None
    bins: BinnedSky | None = None  #: of a dome's image
    following: Following | None = None  #: what is kept until it rests
    direct: F32 | None = None  #: at the cells, of which the present radiance came
    moved: int = 0  #: what `LiveLights.moves` was at its last change
    image: int = 0  #: number of its image, which no other one gets; 0 is that of the scene, or none


class LiveLights:
    """Light of every light at gathers and view, kept per light so that one light's change costs one light.

    A change shows at once, with a shadow ray for every cell and some view samples, less the noise that is known of
    these rays from where the light was at rest; `refine` brings it in steps to the quality of `light_cells` and
    `reflected_direct`. What is reached then depends on the light alone, not on how it got there.

    Parameters
    ----------
    n_bounces : int
        Diffuse reflections before the last one, as `solve_bounces`.
    light_samples, dome_samples : int
        Shadow rays per light and point at rest; domes get four times as many by default.
    sparse : SparseView, optional
        For a first look: domes light these view samples, diffusely, and the others follow from them.
    rows : Transport, optional
        Of the view: what cells are looked at closely goes by what they bring to it, from when the lights first rest.
    """

    def __init__(
        self,
        snapshot: SceneSnapshot,
        tracer: Tracer,
        view: ViewSamples,
        gather: GatherSamples,
        bounces: Bounces,
        *,
        n_bounces: int = 16,
        light_samples: int = 16,
        dome_samples: int | None = None,
        seed: int = 0,
        sparse: SparseView | None = None,
        rows: Transport | None = None,
    ) -> None:
        self._scene, self._seed, self._images = snapshot, seed, LightImages(snapshot.textures)
        self._light_samples, self._dome_samples = light_samples, dome_samples
        self._around: Surroundings = build_surroundings(
            snapshot, tracer, view, gather, bounces, n_bounces, seed, sparse
        )
        self._n_images = 0  # that lights were given
        self._lights = [_Light(one_light(snapshot, light)) for light in range(len(snapshot.lights.kind))]
        n = len(self._lights)
        self.revision = 0  #: grows with everything that changes the light
        self.moves = 0  #: grows with everything that does but gains
        self.gains: F32 = np.ones((n, 3), np.float32)  #: (n_lights, 3)
        self.radiance: F32 = np.zeros((n, gather.n, 3), np.float32)  #: (n_lights, n_gather, 3) at gain 1
        self.view_direct: F32 = np.zeros((n, view.n, 3), np.float32)  #: (n_lights, n_view, 3) at gain 1
        self._suiting: Steps[None] | None = None  # of quick bounces to the lights, once these rest
        self._suited = False  # whether that was done since one of them changed
        self._weighing = None if rows is None else influence_on_view(rows, gather.importance)  # until it is done
        for light in range(n):
            self._show(light)

    @property
    def paths(self) -> tuple[str, ...]:
        """Scene path of each light."""
        return tuple(light.alone.light_paths[0] for light in self._lights)

    @property
    def images(self) -> tuple[int, ...]:
        """Number of each light's image: other images have other numbers; 0 is that of the scene, or none."""
        return tuple(light.image for light in self._lights)

    def take_bounces(self, bounces: Bounces) -> None:
        """Solve the bounces of lights at rest with other rows, such as of more rays.

        Lights on the move get these when all have come to rest.
        """
        self._around.bounces = bounces
        self._forget_suiting()
        for state in self._lights:
            if state.work is not None:
                state.work.restart_bounces()
            elif state.direct is not None:
                state.work = KnownLight(self._around, state.direct)

    def snapshot(self) -> SceneSnapshot:
        """The scene with the lights as they are now; gains are multiplied into their radiance."""
        joined = join_lights(self._scene, [light.alone for light in self._lights])
        return replace(joined, lights=joined.lights._replace(radiance=joined.lights.radiance * self.gains))

    def total(self) -> F32:
        """Radiance `b` that leaves each gather cell under the gains, (n_gather, 3)."""
        return sum_lights(self.radiance * self.gains[:, None, :])

    @property
    def light_moves(self) -> list[int]:
        """What `moves` was when each light last changed but for its gain, (n_lights,)."""
        return [state.moved for state in self._lights]

    def direct(self) -> F32:
        """Direct light that each view sample reflects under the gains, (n_view, 3)."""
        return sum_lights(self.view_direct * self.gains[:, None, :])

    def set_gain(self, light: int, rgb: ArrayLike) -> None:
        """Dim or recolour: factor of what the light was when it was last changed.

        Parameters
        ----------
        rgb : float or (3,)

        Raises
        ------
        LightError
            There is no such light, or `rgb` has another shape, is no number, not finite or negative.
        """
        path = self.paths[self._checked(light)]
        gain = checked_numbers(path, "gain", rgb, () if np.isscalar(rgb) else (3,))
        if (gain < 0.0).any():
            raise LightError(f"gain of {path} must not be negative: {rgb!r}")
        self.gains[light] = gain
        self.revision += 1

    def change(
        self,
        light: int,
        *,
        to_world: ArrayLike | None = None,
        radiance: ArrayLike | None = None,
        size: ArrayLike | None = None,
        texture: F32 | None = None,
    ) -> None:
        """Move, turn, resize one light or give it another colour or image; see `lighting.change.changed_light`.

        Raises
        ------
        LightError
            A value does not fit the light, or the light is a mesh, whose place is geometry.
        """
        state = self._lights[self._checked(light)]
        is_known = texture is None and (state.work is None or state.work.is_known)
        known = state.alone if is_known else None
        state.alone = changed_light(
            self._images, state.alone, to_world=to_world, radiance=radiance, size=size, texture=texture
        )
        if texture is not None:
            state.bins = None
            state.image = self._number(texture)
        self._show(light, known)

    def add(
        self,
        path: str,
        kind: LightKind,
        *,
        to_world: ArrayLike,
        radiance: ArrayLike,
        size: ArrayLike = (0.0, 0.0),
        texture: F32 | None = None,
    ) -> int:
        """Add a light behind the others; returns its number."""
        alone = new_light(
            self._scene, self._images, path, kind, to_world=to_world, radiance=radiance, size=size, texture=texture
        )
        self._lights.append(_Light(alone, image=self._number(texture)))
        self.gains = np.concatenate([self.gains, np.ones((1, 3), np.float32)])
        self.radiance = np.concatenate([self.radiance, np.zeros((1, *self.radiance.shape[1:]), np.float32)])
        self.view_direct = np.concatenate([self.view_direct, np.zeros((1, *self.view_direct.shape[1:]), np.float32)])
        self._show(len(self._lights) - 1)
        return len(self._lights) - 1

    def remove(self, light: int) -> None:
        """Take a light away; those behind it move up by one."""
        self._checked(light)
        self._forget_suiting()
        self.revision += 1
        self.moves += 1
        del self._lights[light]
        self.gains = np.delete(self.gains, light, axis=0)
        self.radiance = np.delete(self.radiance, light, axis=0)
        self.view_direct = np.delete(self.view_direct, light, axis=0)

    def refine(self) -> bool:
        """One step, some tens of milliseconds, towards the final quality of a light; False when nothing is left.

        The last steps show nothing: they are for light that moves from here.
        """
        for light, state in enumerate(self._lights):
            if state.work is not None:
                more = state.work.step(self.radiance[light], self.view_direct[light])
                state.direct = state.work.direct
                if not more:
                    state.work = state.following = None
                self.revision += 1
                self.moves = state.moved = self.moves + 1
                return True
        return self._weigh_cells() or self._suit_bounces()

    def _weigh_cells(self) -> bool:
        """One step of finding what each cell brings to the view; False when that is known."""
        if self._weighing is None:
            return False
        try:
            next(self._weighing)
        except StopIteration as end:
            self._around.influence, self._weighing = end.value, None
        return True

    def _suit_bounces(self) -> bool:
        """One step of making rows of which these lights, and what is like them, has little noise; False when done."""
        if self._suited:
            return False
        if self._suiting is None:
            importance = np.full(self.radiance.shape[1], max(_ALIKE, len(self._lights)), np.float32)
            for radiance in self.radiance:
                light = radiance[:, 0] + radiance[:, 1] + radiance[:, 2]
                importance += light / max(light.mean(), np.finfo(np.float32).tiny)
            self._suiting = self._around.suit_bounces(importance)
        if next(self._suiting, True):
            self._suiting, self._suited = None, True
        return not self._suited

    def _forget_suiting(self) -> None:
        """Rows are to be made anew once all lights rest; what there is of them takes memory until then."""
        self._suiting, self._suited = None, False

    def stop_following(self) -> None:
        """Let go of what lights in motion are followed with, as their next move may be long in coming."""
        self._suiting = None
        for state in self._lights:
            state.following = None
            if isinstance(state.work, (AnyLight, MovingLight)):
                state.work.following = None

    def cell_light(self) -> CellLight:
        """What `Relighter` takes, from the present state; its `direct` is not kept and empty."""
        return CellLight(np.zeros((len(self._lights), 0, 3), np.float32), self.radiance)

    def _number(self, image: F32 | None) -> int:
        if image is None or not np.size(image):
            return 0
        self._n_images += 1
        return self._n_images

    def _checked(self, light: int) -> int:
        if not 0 <= light < len(self._lights):
            raise LightError(f"there is no light {light}; the scene has {len(self._lights)}")
        return light

    def _show(self, light: int, known: SceneSnapshot | None = None) -> None:
        """First look; `known` is the light as it was, if what it brings is known well."""
        self._forget_suiting()
        state = self._lights[light]
        # By name, not by number: a light keeps its random numbers when others come or go.
        seed = (self._seed + zlib.crc32(state.alone.light_paths[0].encode())) & 0x7FFFFFFF
        counts = self._light_samples, self._dome_samples
        kind = MovingLight if self._around.can_move(state.alone) else AnyLight
        work = kind(self._around, state.alone, seed, *counts)
        if isinstance(work, AnyLight):
            work.bins = state.bins
        work.direct = state.direct
        work.following = state.following
        work.show(self.radiance[light], self.view_direct[light], known)
        state.work, state.direct, state.following = work, work.direct, work.following
        state.bins = work.bins if isinstance(work, AnyLight) else None
        self.revision += 1
        self.moves = state.moved = self.moves + 1
