"""The home of ``pxr``: what a stage holds becomes a snapshot, and edits become opinions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from icheat_usd.stage import _announce  # noqa: F401  before USD loads
from icheat_usd.stage.opening import open_stage

if TYPE_CHECKING:
    from icheat_usd.stage.snapshot import take_snapshot

__all__ = ["open_stage", "take_snapshot"]


def __getattr__(name: str) -> Any:
    # A snapshot needs the kernels' compiler, which takes longer to load than a stage and which a host that only
    # reads and authors edits may lack.
    if name == "take_snapshot":
        from icheat_usd.stage.snapshot import take_snapshot

        return take_snapshot
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
