"""How much work goes into a final gather."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from icheat_usd.final_gather.irradiance_cache import CacheSettings
from icheat_usd.samples.pixel_filter import PixelFilter

METHODS = ("cached", "gathered", "brute")
BOUNCES = ("cells", "photons")


@dataclass(frozen=True)
class GatherSettings:
    """Effort of a final gather.

    Raises
    ------
    ValueError, SettingsError
        A value makes no sense.
    """

    samples_per_pixel: int = 4
    gather_rays: int = 64  #: per camera sample and lobe that has no cache; the "gathered" method sends 4, 8, 16, 32 ...
    light_samples: int = 8  #: shadow rays per light and camera sample, for direct light
    n_bounces: int = 16  #: diffuse reflections before the last one
    seed: int = 0
    dome_samples: int | None = None  #: `light_samples` of domes; 4 times those of other lights by default
    #: "cached" interpolates irradiance between records and takes earlier bounces from the gather samples; "gathered"
    #: takes these too, for rays of every camera sample: noisy, and quickest for what is denoised; "brute" follows paths
    #: from every camera sample: slow, unbiased, what all else is measured against.
    method: str = "cached"
    #: More camera samples in pixels that hold edges of the picture; best a power of two with the others: 8 of them
    #: show edges with less noise than 9.
    edge_samples: int = 12
    glossy_rays: int = 16  #: per camera sample of a glossy surface, where diffuse light is cached
    cache: CacheSettings = field(default_factory=CacheSettings)
    pixel_filter: str = "box"  #: or "triangle", "gaussian", "blackman-harris"
    filter_width: float = 0.0  #: of its support, pixels; 0 is the usual width of each filter
    #: Number of a pixel's first camera sample, where this image is to be one of several that are added up; None where
    #: it stands alone.
    first_sample: int | None = None
    first_edge_sample: int | None = None  #: the same for those in pixels with edges; None: after the others

    #: How earlier bounces are solved, where no paths are followed for them: "cells" by the exchange of light between
    #: gather samples, "photons" by light traced forwards.
    bounces: str = "cells"
    denoise: bool = False  #: by Open Image Denoise, which must be installed
    #: More camera samples in pixels with edges, which no light is found for: they say where the sky begins, and a
    #: denoiser takes edges from their albedo and normal.
    feature_samples: int = 0

    def __post_init__(self) -> None:
        if self.bounces not in BOUNCES:
            raise ValueError(f"bounces '{self.bounces}' is none of {', '.join(BOUNCES)}")
        if self.method not in METHODS:
            raise ValueError(f"method '{self.method}' is none of {', '.join(METHODS)}")
        if self.samples_per_pixel < 1 or min(self.edge_samples, self.feature_samples) < 0:
            raise ValueError("samples_per_pixel is at least 1, and edge_samples and feature_samples at least 0")
        PixelFilter(self.pixel_filter, self.filter_width)

    @property
    def is_cached(self) -> bool:
        """Whether light is interpolated between records."""
        return self.method == "cached"

    @property
    def uses_cells(self) -> bool:
        """Whether earlier bounces are those of the gather samples."""
        return self.method != "brute"

    @property
    def own_strata(self) -> tuple[int, int]:
        """Rings and sectors of the rays of a camera sample that no record reaches, 2 or multiples of 4.

        Of the cached method such samples, of pixels with edges, share the rays that a record has.
        """
        if self.is_cached:
            share = math.sqrt(self.samples_per_pixel + self.edge_samples)
            rings = 4 * max(1, round(self.cache.n_theta / (4 * share)))
            return rings, 3 * rings
        if self.gather_rays <= 8:
            return 2, 2 if self.gather_rays <= 4 else 4
        rings = 4 * max(1, round(math.sqrt(self.gather_rays / 3) / 4))
        return rings, 4 * math.ceil(self.gather_rays / (4 * rings))
