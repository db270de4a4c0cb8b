"""Light sources: sampling, environment maps, direct light at surface points."""

from icheat_usd.lighting.direct import irradiance, reflected_direct, samples_per_light
from icheat_usd.lighting.environment import environment_radiance, environment_radiance_per_light
from icheat_usd.lighting.sampler import LightSampler, build_light_sampler, prepare_light_sampler

__all__ = [
    "LightSampler",
    "build_light_sampler",
    "environment_radiance",
    "environment_radiance_per_light",
    "irradiance",
    "prepare_light_sampler",
    "reflected_direct",
    "samples_per_light",
]
