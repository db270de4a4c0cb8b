"""How much work goes into an image."""

from __future__ import annotations

from dataclasses import dataclass, replace

from icheat_usd.final_gather import GatherSettings


@dataclass(frozen=True)
class Quality:
    """Effort of the preview.

    The defaults suit a 640 x 480 frame: 65,536 gather samples and 256 rays a row.
    """

    n_gather: int = 65_536
    rays_per_row: int = 256
    rays_per_bounce_row: int = 128
    rest_bounce_rays: int | None = None  #: of such a row for live lights at rest; None: no more than at first
    row_spacing: int = 1  #: pixels between the points where rows are kept; the rest is interpolated
    shared_rays: bool = False  #: the same rays from all of these: a smooth shade instead of noise
    record_error: float | None = None  #: relative RMS error that rows kept where they are needed, instead of on a grid,
    #: may add by interpolation; None keeps them on the grid of `row_spacing`
    record_share: float = 0.2  #: of the view samples, that such rows are kept at, at most
    record_rays: int = 1792  #: gather rays of such a row, on average
    packing_error: float | None = None  #: relative RMS error that packed rows may add; None keeps them exact
    #: Coefficients of 64 rows, on average, that are kept even so, until that error is 0.7 of it.
    packing_spare: int = 0
    #: While lights move, terms that are small in their light are not read: errors of that are divided by this.
    moving_detail: float = 1.0
    light_samples: int = 16  #: shadow rays per light and point, at rest; more where an image is grainy
    dome_samples: int | None = None  #: for the direct light of domes in the image; 4 `light_samples` by default
    #: Places that are told apart in learning where the light of domes comes from.
    dome_places: int = 512
    n_bounces: int = 16  #: diffuse reflections before the last one
    samples_per_pixel: int = 1
    seed: int = 0


#: Seconds rather than a minute: for a first look, and for tests.
DRAFT = Quality(n_gather=8_192, rays_per_row=64, rays_per_bounce_row=64, row_spacing=4, light_samples=8)

PREVIEW = Quality()

#: Rows at few points, with many rays each: faster to make than `PREVIEW`, and less noisy, so that noise of bounces
#: would show.
RECORDS = replace(PREVIEW, record_error=0.01, rays_per_bounce_row=256)

#: The same, packed so that a frame takes milliseconds. Lights that an artist sets lose a third to all of what plausible
#: lights lose, among which are beams on few cells; what is lost beyond this is noise of the rows. Where few
#: coefficients do for that, a product takes a millisecond or two, and more of them are worth their time.
LIVE = replace(RECORDS, rest_bounce_rays=1024, packing_error=0.0275, packing_spare=2400)

#: For a close look at what lives on: about two and a half times as many records, which twice the rays would be wasted
#: without. Some lights lose all of what plausible ones lose by packing, and are to be within a percent nevertheless.
LIVE_FINE = replace(
    LIVE,
    record_error=0.0015,
    record_share=0.7,
    record_rays=4096,
    rays_per_bounce_row=1024,
    packing_error=0.01,
    moving_detail=3.0,
)
FINAL = GatherSettings()

#: A final frame in seconds: few rays of every camera sample, and what they leave of noise goes to the denoiser. Its
#: gather samples are those of `QUICK_CELLS`.
QUICK = GatherSettings(
    1,
    gather_rays=8,
    light_samples=1,
    dome_samples=2,
    method="gathered",
    edge_samples=1,
    feature_samples=6,
    cache=replace(FINAL.cache, near_paths=16),
    denoise=True,
)
QUICK_CELLS = replace(PREVIEW, n_gather=8_192, rays_per_bounce_row=32, dome_places=256)


def coarse(quality: Quality) -> Quality:
    """What to show within seconds, while a preview of this quality is made."""
    return replace(
        quality,
        n_gather=min(quality.n_gather, 4_096),
        rays_per_row=min(quality.rays_per_row, 64),
        rays_per_bounce_row=min(quality.rays_per_bounce_row, 16),
        rest_bounce_rays=None,
        row_spacing=max(quality.row_spacing, 8),
        shared_rays=True,
        record_error=None,
        packing_error=None,
        light_samples=min(quality.light_samples, 2),
        dome_samples=min(quality.dome_samples or 4, 4),
        samples_per_pixel=1,
    )
