"""The home of ``pxr``: what a stage holds becomes a snapshot, and edits become opinions."""

from icheat_usd.stage.opening import open_stage
from icheat_usd.stage.snapshot import take_snapshot

__all__ = ["open_stage", "take_snapshot"]
