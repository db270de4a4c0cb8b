"""The final gather: the frame that ships, with edits evaluated where rays really land."""

from icheat_usd.final_gather.denoised import denoised, denoised_layer, with_denoising
from icheat_usd.final_gather.extras import NO_EXTRAS, Extras
from icheat_usd.final_gather.integrator import FinalGather, final_gather
from icheat_usd.final_gather.irradiance_cache import CacheSettings
from icheat_usd.final_gather.moments import weighted_gather
from icheat_usd.final_gather.settings import GatherSettings

__all__ = [
    "NO_EXTRAS",
    "CacheSettings",
    "Extras",
    "FinalGather",
    "GatherSettings",
    "denoised",
    "denoised_layer",
    "final_gather",
    "weighted_gather",
    "with_denoising",
]
