"""A final frame that is made again with other edits, in a fraction of the time that the render took."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from icheat_usd.edits.binding import bind
from icheat_usd.errors import ImageError, SettingsError
from icheat_usd.final_gather import GatherSettings
from icheat_usd.image.film import Film
from icheat_usd.session import aovs, layer_names
from icheat_usd.session.films import image_metadata
from icheat_usd.session.rendering import gather_frame
from icheat_usd.session.shutter import moments

if TYPE_CHECKING:
    from icheat_usd.session.document import Session

_OF_EDITS = ("crypto_edit", "unlit")
_FAMILIES_OF_EDITS = ("edit", "light", "light_indirect_edited")


class FrameReplay:
    """A rendered frame that follows the stage's edits: change them as the session or the stage lets one, ask again.

    Scene, camera and lights are those of the render.

    Parameters
    ----------
    settings : GatherSettings
        Of another method than brute, without denoising.
    layers : names
        As of `Session.render`, but for what the edits contribute one by one, what they make of single lights, and
        their mattes.

    Raises
    ------
    SettingsError
        The settings, or a camera's open shutter, allow no replay.
    ImageError
        There is no such layer, or it cannot be replayed.
    """

    def __init__(self, session: Session, settings: GatherSettings, layers: Sequence[str] = layer_names.DEFAULT) -> None:
        if not settings.uses_cells or settings.denoise:
            raise SettingsError("a frame can be replayed if it is not rendered by the brute method, nor denoised")
        if len(list(moments(session, settings.samples_per_pixel, settings.edge_samples))) > 1:
            raise SettingsError(
                f"{session.snapshot.camera.path}: a frame with motion blur cannot be replayed; close the camera's "
                "shutter or author disableMotionBlur on the render settings"
            )
        self._session, self._settings, self._snapshot = session, settings, session.snapshot
        scene = aovs.layer_scene(session.snapshot, session.stack)
        sources = [layer_names.canonical(name) for name in layers]
        asked = [layer_names.Layer(source, layer_names.layer_name(source)) for source in sources]
        self._members = aovs.expanded(asked, scene)
        refused = [
            member.source
            for member in self._members
            if member.source in _OF_EDITS or member.source.partition(".")[0] in _FAMILIES_OF_EDITS
        ]
        if refused:
            raise ImageError(f"layer '{refused[0]}' cannot be replayed; render it, or leave it out")
        self._scene = scene
        self._result = gather_frame(session, settings, aovs.needed(self._members, scene), is_kept=True)

    def film(self) -> Film:
        """The frame under the edits as they are now."""
        session = self._session
        stack = session.stack
        replay = self._result.replay
        assert replay is not None
        known = replay.known if session.snapshot is self._snapshot else None
        edited = replay.edited(bind(stack, session.snapshot, known))
        metadata = image_metadata(session.snapshot, "final gather", stack, asdict(self._settings))
        result = replace(self._result, indirect_edited=edited)
        return aovs.make_film(result, self._members, self._scene, session.snapshot, metadata)
