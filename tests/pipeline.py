"""The renderers on a snapshot, without a stage, at sizes that suit tests."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from icheat_usd.edits.binding import bind
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import EMPTY_STACK, Edit, EditStack, Selection
from icheat_usd.final_gather import NO_EXTRAS, CacheSettings, Extras, FinalGather, GatherSettings, final_gather
from icheat_usd.relight import Relighter, RelitView, build_relighter
from icheat_usd.samples import GatherSamples, ViewSamples, gather_samples, view_samples
from icheat_usd.samples.develop import develop
from icheat_usd.scene import F64, SceneSnapshot
from icheat_usd.tracing import Tracer, build_tracer
from icheat_usd.transport import Bounces, CellLight, Transport, build_bounces, build_transport, light_cells

#: Records of an image so small that two pixels are a tenth of it. They end half way to the nearest surface, as nothing
#: else keeps them from being as wide as what operations that look at the receiver's place vary over.
TINY = CacheSettings(n_theta=16, least_reach=0.5, clearance=0.5)


@dataclass
class Pipeline:
    """Parts of a preview, each made when first needed."""

    snapshot: SceneSnapshot
    n_gather: int = 2048
    rays: int = 1024
    bounce_rays: int = 256
    light_samples: int = 64
    n_bounces: int = 24
    row_spacing: int = 1
    samples_per_pixel: int = 1
    seed: int = 0
    engine: str = "embree"

    @cached_property
    def tracer(self) -> Tracer:
        return build_tracer(self.snapshot, self.engine)

    @cached_property
    def view(self) -> ViewSamples:
        return view_samples(self.snapshot, self.tracer, samples_per_pixel=self.samples_per_pixel, seed=self.seed)

    @cached_property
    def gather(self) -> GatherSamples:
        return gather_samples(self.snapshot, self.tracer, self.view, n=self.n_gather, seed=self.seed)

    @cached_property
    def transport(self) -> Transport:
        return build_transport(
            self.snapshot,
            self.tracer,
            self.view,
            self.gather,
            rays_per_row=self.rays,
            row_spacing=self.row_spacing,
            seed=self.seed,
        )

    @cached_property
    def bounces(self) -> Bounces:
        return build_bounces(self.snapshot, self.tracer, self.gather, rays_per_row=self.bounce_rays, seed=self.seed)

    @cached_property
    def cell_light(self) -> CellLight:
        return light_cells(
            self.snapshot,
            self.tracer,
            self.gather,
            self.bounces,
            n_bounces=self.n_bounces,
            light_samples=self.light_samples,
            seed=self.seed,
        )

    @cached_property
    def relighter(self) -> Relighter:
        return build_relighter(
            self.snapshot,
            self.tracer,
            self.view,
            self.gather,
            self.transport,
            self.cell_light,
            light_samples=self.light_samples,
            seed=self.seed,
        )

    def field(self, *edits: Edit) -> EditField:
        return bind(EditStack("/stack", edits) if edits else EMPTY_STACK, self.snapshot)

    def relight(self, *edits: Edit) -> RelitView:
        return self.relighter.relight(self.field(*edits))

    def image(self, radiance: np.ndarray) -> F64:
        return develop(self.view, radiance).reshape(self.view.height, self.view.width, 3)

    def final(
        self,
        *edits: Edit,
        method: str = "brute",
        samples: int = 4,
        rays: int = 256,
        light_samples: int = 16,
        seed: int = 0,
        edge_samples: int = 0,
        feature_samples: int = 0,
        cache: CacheSettings = TINY,
        extras: Extras = NO_EXTRAS,
    ) -> FinalGather:
        settings = GatherSettings(
            samples,
            rays,
            light_samples,
            self.n_bounces,
            seed,
            method=method,
            edge_samples=edge_samples,
            feature_samples=feature_samples,
            cache=cache,
        )
        field = self.field(*edits)
        needs = settings.uses_cells or field.uses_incident or field.has_offset
        return final_gather(
            self.snapshot,
            self.tracer,
            field,
            settings=settings,
            gather=self.gather if needs else None,
            gather_radiance=self.cell_light.radiance if needs else None,
            extras=extras,
        )


def select(*paths: str) -> Selection:
    return Selection(frozenset(paths))
