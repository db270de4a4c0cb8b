"""Which gather sample a place on a surface belongs to."""

from __future__ import annotations

from dataclasses import dataclass

from icheat_usd.scene import F32, I32, U8


@dataclass(frozen=True)
class Locator:
    """Nearest gather sample on the same side of the same instance."""

    def locate(self, position: F32, normal: F32, instance: I32, side: U8) -> I32:
        raise NotImplementedError
