"""Everything that a preview of one frame is made of, each part computed once, or found where it was kept."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Protocol, TypeVar, cast

from icheat_usd.final_gather.photon_map import photon_cell_radiance
from icheat_usd.final_gather.photons import PhotonSettings
from icheat_usd.lighting import LightSampler, build_light_sampler
from icheat_usd.lighting.guide import Effort
from icheat_usd.progress import Progress, silent
from icheat_usd.relight import Relighter
from icheat_usd.relight.view_light import light_view
from icheat_usd.samples import GatherSamples, ViewSamples, cell_direct, gather_samples, view_samples
from icheat_usd.samples.gather import pilot_pixels
from icheat_usd.scene import F32, SceneSnapshot
from icheat_usd.session.content_keys import ShotKeys, shot_keys
from icheat_usd.session.disk_cache import DiskCache, Shelf
from icheat_usd.session.quality import Quality
from icheat_usd.tracing import Tracer, build_tracer
from icheat_usd.transport import (
    Bounces,
    CellLight,
    HeldBack,
    Transport,
    build_bounces,
    build_transport,
    light_cells,
    more_bounces,
)
from icheat_usd.transport.packed import PackedTransport
from icheat_usd.transport.packing import pack
from icheat_usd.transport.progressive import build_transports
from icheat_usd.transport.records import RecordSettings
from icheat_usd.transport.training import training_radiance

Part = TypeVar("Part")

#: Records that any image may have, however small it is.
FEWEST_RECORDS = 8_192

#: Photons that leave lights, for each gather sample.
PHOTONS_PER_CELL = 16

#: What takes less time to make than this is not kept on disk: reading it back would take as long.
WORTH_KEEPING_SECONDS = 1.0


class Memory(Protocol):
    """Keeps parts that several frames share; see `frames.SharedParts`."""

    def get(self, kind: str, key: str, make: Callable[[], Part]) -> Part:
        """The part of this key, made if it is not there."""

    def find(self, kind: str, key: str) -> Any | None:
        """The part of this key, if it is there."""

    def keep(self, kind: str, key: str, part: Part) -> Part:
        """The part, or the one that was there first."""


class ShotParts:
    """One camera at one time: samples, transport and light; `snapshot` is given or overridden.

    Parameters
    ----------
    disk : DiskCache, optional
        Where expensive parts are found again by another session; by default as the environment says.
    memory : Memory, optional
        Where other frames find parts that are the same.
    """

    def __init__(
        self,
        quality: Quality,
        *,
        snapshot: SceneSnapshot | None = None,
        engine: str = "embree",
        progress: Progress = silent,
        disk: DiskCache | None = None,
        memory: Memory | None = None,
    ) -> None:
        self.quality = quality
        self.progress = progress
        self._engine = engine
        self._disk = DiskCache() if disk is None else disk
        self._memory = memory
        if snapshot is not None:
            self.__dict__["snapshot"] = snapshot

    @property
    def engine(self) -> str:
        """Name of the ray tracer."""
        return self._engine

    @cached_property
    def snapshot(self) -> SceneSnapshot:
        """What is rendered."""
        raise NotImplementedError

    @cached_property
    def keys(self) -> ShotKeys:
        """Names of the parts by what they depend on."""
        return shot_keys(self.snapshot, self.quality, self._engine)

    @cached_property
    def tracer(self) -> Tracer:
        if self._memory is None:
            return build_tracer(self.snapshot, self._engine)
        return self._memory.get("tracer", self.keys.scene, lambda: build_tracer(self.snapshot, self._engine))

    @cached_property
    def view(self) -> ViewSamples:
        def make(_: Shelf | None) -> ViewSamples:
            self.progress("place view samples", 0.0)
            n, seed = self.quality.samples_per_pixel, self.quality.seed
            return view_samples(self.snapshot, self.tracer, samples_per_pixel=n, seed=seed)

        return self._kept("view", ("tracer",), make)

    @cached_property
    def gather(self) -> GatherSamples:
        def make(_: Shelf | None) -> GatherSamples:
            n, seed, samples = self.quality.n_gather, self.quality.seed, self.quality.samples_per_pixel
            self.progress("place gather samples", 0.0)
            pixels = pilot_pixels(self.snapshot.camera, samples)
            view = view_samples(self.snapshot, self.tracer, samples_per_pixel=samples, seed=seed, pixels=pixels)
            return gather_samples(self.snapshot, self.tracer, view, n=n, seed=seed)

        return self._kept("gather", ("tracer",), make)

    @cached_property
    def light_sampler(self) -> LightSampler:
        """What lights of the gather samples are sampled by; it knows where around these they can be seen."""
        quality, points = self.quality, self.gather.patch_points
        effort = Effort(leaves=quality.dome_places)
        return build_light_sampler(self.snapshot, self.tracer, points, quality.seed, effort)

    @cached_property
    def training(self) -> F32:
        """What plausible lights make leave the gather samples: what rows and coefficients are chosen by."""

        def make(_: Shelf | None) -> F32:
            self.progress("try plausible lights", 0.0)
            return training_radiance(self.snapshot, self.tracer, self.gather, self.bounces, seed=self.quality.seed)

        return self._kept("training", ("bounces",), make)

    @cached_property
    def transport(self) -> Transport:
        """Exact rows, at all view samples or at records."""

        def make(shelf: Shelf | None) -> Transport:
            return deque(self._measured(shelf), maxlen=1).pop()

        needs = ("gather",) if self.quality.record_error is None else ("training",)
        return self._kept("transport", needs, make)

    @cached_property
    def packed(self) -> PackedTransport:
        """The transport in few bytes; the error of that is a setting."""
        error = self.quality.packing_error
        if error is None:
            raise ValueError("this quality asks for exact rows; give it a packing_error")

        def make(_: Shelf | None) -> PackedTransport:
            rows, training, spare = self.transport, self.training, self.quality.packing_spare
            packed = pack(rows, self.gather, training, error, spare=spare, progress=self.progress)
            # The exact rows have a shelf of their own.
            return replace(packed, source=None)

        def whole() -> PackedTransport:
            packed = self._from_disk("packed", ("transport", "training"), make)
            return replace(packed, source=self.transport)

        return whole() if self._memory is None else self._memory.get("packed", self.keys.packed, whole)

    @property
    def is_shared(self) -> bool:
        """Whether another frame in memory has the rows of this one."""
        kind = "transport" if self.quality.packing_error is None else "packed"
        return self._memory is not None and self._memory.find(kind, getattr(self.keys, kind)) is not None

    def transports(self) -> Iterator[Transport | PackedTransport]:
        """Better and better ones, each usable; the last is what the quality asks for."""
        is_packed = self.quality.packing_error is not None
        if not self._is_there("transport"):
            last: Transport | None = None
            shelf = self._shelf("transport") if self._disk.is_on else None
            for last in self._measured(shelf):
                yield last
            assert last is not None
            if self._memory is not None:
                last = self._memory.keep("transport", self.keys.transport, last)
            self.__dict__["transport"] = last
            if shelf is not None:
                shelf.keep_whole(last)
            if not is_packed:
                return
        yield self.packed if is_packed else self.transport

    def _measured(self, shelf: Shelf | None) -> Iterator[Transport]:
        quality = self.quality
        if quality.record_error is None:
            yield build_transport(
                self.snapshot,
                self.tracer,
                self.view,
                self.gather,
                rays_per_row=quality.rays_per_row,
                row_spacing=quality.row_spacing,
                shared_rays=quality.shared_rays,
                seed=quality.seed,
                progress=self.progress,
            )
            return
        yield from build_transports(
            self.snapshot,
            self.tracer,
            self.view,
            self.gather,
            self.training,
            settings=_record_settings(quality.record_error, quality.record_share, self.view.n),
            rays_per_row=quality.record_rays,
            seed=quality.seed,
            progress=self.progress,
            parts=shelf,
        )

    @cached_property
    def bounces(self) -> Bounces:
        """Light from gather samples to gather samples."""

        def make(_: Shelf | None) -> Bounces:
            rays, seed = self.quality.rays_per_bounce_row, self.quality.seed
            return build_bounces(
                self.snapshot, self.tracer, self.gather, rays_per_row=rays, seed=seed, progress=self.progress
            )

        return self._kept("bounces", ("gather",), make)

    @property
    def has_rest_bounces(self) -> bool:
        """Whether the quality asks for other bounces of live lights at rest."""
        return (self.quality.rest_bounce_rays or 0) > self.quality.rays_per_bounce_row

    @cached_property
    def rest_bounces(self) -> Bounces:
        """The same by more rays, for live lights at rest; `bounces` themselves where the quality asks for no more."""
        if not self.has_rest_bounces:
            return self.bounces
        rays, more = self.quality.rays_per_bounce_row, self.quality.rest_bounce_rays
        assert more is not None

        def make(_: Shelf | None) -> Bounces:
            scene = self.snapshot, self.tracer, self.gather
            return more_bounces(*scene, self.bounces, rays, more - rays, seed=self.quality.seed, progress=self.progress)

        return self._kept("rest_bounces", ("bounces",), make)

    @cached_property
    def cell_light(self) -> CellLight:
        """Light that leaves the gather samples, of all bounces but the last."""

        def make(_: Shelf | None) -> CellLight:
            quality = self.quality
            return light_cells(
                self.snapshot,
                self.tracer,
                self.gather,
                self.bounces,
                n_bounces=quality.n_bounces,
                light_samples=quality.light_samples,
                seed=quality.seed,
                sampler=self.light_sampler,
                progress=self.progress,
            )

        return self._kept("cell_light", ("bounces",), make)

    @cached_property
    def photon_light(self) -> CellLight:
        """The same light, its bounces after the first by photons."""
        quality = self.quality
        n_emitted = PHOTONS_PER_CELL * self.gather.n
        settings = PhotonSettings(n_emitted, n_bounces=quality.n_bounces, seed=quality.seed)
        scene = self.snapshot, self.tracer, self.light_sampler, self.gather
        direct = cell_direct(*scene, quality.light_samples, quality.seed)
        radiance = photon_cell_radiance(
            self.snapshot, self.tracer, self.gather, direct, settings, progress=self.progress
        )
        return CellLight(direct, radiance)

    @cached_property
    def view_light(self) -> F32:
        """Direct light that the view samples reflect, (n_lights, n_view, 3)."""

        def make(_: Shelf | None) -> F32:
            quality = self.quality
            return light_view(
                self.snapshot,
                self.tracer,
                self.view,
                light_samples=quality.light_samples,
                dome_samples=quality.dome_samples,
                seed=quality.seed,
                progress=self.progress,
            )

        return self._kept("view_light", ("view",), make)

    @cached_property
    def relighter(self) -> Relighter:
        held_back = HeldBack(self.snapshot, self.tracer, self.view, self.gather, self.transport, self.progress)
        return Relighter(self.view, self.gather, self.transport, self.view_light, self.cell_light, held_back)

    def _kept(self, kind: str, needs: Sequence[str], make: Callable[[Shelf | None], Part]) -> Part:
        """A part from memory, else from disk, else made. `make` gets a shelf for the pieces of a long build."""
        if self._memory is not None:
            return self._memory.get(kind, getattr(self.keys, kind), lambda: self._from_disk(kind, needs, make))
        return self._from_disk(kind, needs, make)

    def _from_disk(self, kind: str, needs: Sequence[str], make: Callable[[Shelf | None], Part]) -> Part:
        if not self._disk.is_on:
            return make(None)
        shelf = self._shelf(kind)
        found = shelf.load("whole")
        if found is not None:
            return cast(Part, found)
        # First, so that their time does not count.
        for name in needs:
            getattr(self, name)
        began = time.perf_counter()
        made = make(shelf)
        if time.perf_counter() - began > WORTH_KEEPING_SECONDS:
            shelf.keep_whole(made)
        else:
            shelf.drop(*shelf.names())
        return made

    def _shelf(self, kind: str) -> Shelf:
        return self._disk.shelf(kind, getattr(self.keys, kind), self._about())

    def _is_there(self, kind: str) -> bool:
        """Whether a part need not be made."""
        if kind in self.__dict__:
            return True
        if self._memory is not None and self._memory.find(kind, getattr(self.keys, kind)) is not None:
            return True
        return self._disk.is_on and "whole" in self._shelf(kind).names()

    def _about(self) -> dict[str, Any]:
        """For people who look at the cache."""
        camera = self.snapshot.camera
        return {
            "stage": self.snapshot.stage_path,
            "camera": camera.path,
            "frame": self.snapshot.time_code,
            "width": camera.width,
            "height": camera.height,
        }


def _record_settings(error: float, share: float, n_view: int) -> RecordSettings:
    """Of a large image few samples are enough; what interpolates in a small one are its very features."""
    return RecordSettings(tolerance=error, max_share=min(1.0, max(share, FEWEST_RECORDS / max(n_view, 1))))
