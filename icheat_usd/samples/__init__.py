"""View samples, gather samples and the cluster tree over them."""

from icheat_usd.samples.gather import GatherSamples, cell_direct, gather_samples, instance_areas
from icheat_usd.samples.tree import ClusterTree
from icheat_usd.samples.view import ViewSamples, view_samples

__all__ = [
    "ClusterTree",
    "GatherSamples",
    "ViewSamples",
    "cell_direct",
    "gather_samples",
    "instance_areas",
    "view_samples",
]
