"""The relighter: edits and light changes previewed through the precomputed transport."""

from icheat_usd.relight.relighter import Relighter, RelitView, build_relighter

__all__ = ["RelitView", "Relighter", "build_relighter"]
