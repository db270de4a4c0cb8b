"""The final gather: the frame that ships, with edits evaluated where rays really land."""

from icheat_usd.final_gather.extras import NO_EXTRAS, Extras
from icheat_usd.final_gather.integrator import FinalGather, GatherSettings, final_gather

__all__ = ["NO_EXTRAS", "Extras", "FinalGather", "GatherSettings", "final_gather"]
