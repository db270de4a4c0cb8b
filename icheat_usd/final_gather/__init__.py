"""The final gather: the frame that ships, with edits evaluated where rays really land."""

from icheat_usd.final_gather.integrator import FinalGather, GatherSettings, final_gather

__all__ = ["FinalGather", "GatherSettings", "final_gather"]
