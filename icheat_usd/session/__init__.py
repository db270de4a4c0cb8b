"""An open document without a window: what scripts, the shell and user interfaces talk to.

    session = Session.open("shot.usda", camera="/World/Camera", frame=12)
    session.add_edit("warm", layer="shot.usda", operation="scale", parameters={"color": (1.4, 1.1, 0.8)},
                     receivers=["/World/Figure"], casters=["/World/Room/Wall"])
    write_exr(session.relight(), "preview.exr")
    write_exr(session.render(), "final.exr")

Names are loaded when first used: authoring needs no kernels, and should not wait for them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from icheat_usd.edits.painting import soft_sphere
    from icheat_usd.final_gather import GatherSettings
    from icheat_usd.session.authoring import add_edit, create_stack, move_edit, mute_edit, remove_edit, set_edit
    from icheat_usd.session.differences import compare_stages
    from icheat_usd.session.document import Session
    from icheat_usd.session.explain import contribution_film, explain_pixel
    from icheat_usd.session.inspection import check
    from icheat_usd.session.keys import copy_key, list_keys, remove_key, set_key
    from icheat_usd.session.live import LiveSession
    from icheat_usd.session.publishing import publish
    from icheat_usd.session.quality import DRAFT, LIVE, LIVE_FINE, Quality

__all__ = [
    "DRAFT",
    "LIVE",
    "LIVE_FINE",
    "GatherSettings",
    "LiveSession",
    "Quality",
    "Session",
    "add_edit",
    "check",
    "compare_stages",
    "contribution_film",
    "copy_key",
    "create_stack",
    "explain_pixel",
    "list_keys",
    "move_edit",
    "mute_edit",
    "publish",
    "remove_edit",
    "remove_key",
    "set_edit",
    "set_key",
    "soft_sphere",
]

_HOMES = {
    "check": "icheat_usd.session.inspection",
    "compare_stages": "icheat_usd.session.differences",
    "contribution_film": "icheat_usd.session.explain",
    "copy_key": "icheat_usd.session.keys",
    "explain_pixel": "icheat_usd.session.explain",
    "list_keys": "icheat_usd.session.keys",
    "publish": "icheat_usd.session.publishing",
    "remove_key": "icheat_usd.session.keys",
    "set_key": "icheat_usd.session.keys",
    "soft_sphere": "icheat_usd.edits.painting",
    "GatherSettings": "icheat_usd.final_gather",
    "LiveSession": "icheat_usd.session.live",
    "Session": "icheat_usd.session.document",
    "DRAFT": "icheat_usd.session.quality",
    "LIVE": "icheat_usd.session.quality",
    "LIVE_FINE": "icheat_usd.session.quality",
    "Quality": "icheat_usd.session.quality",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES.get(name, "icheat_usd.session.authoring")), name)
