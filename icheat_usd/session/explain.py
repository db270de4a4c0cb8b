"""Which edits touch a pixel, by how much and from which casters; and the same as maps of a whole image.

An edit's contribution is what would change without it: the image of the whole
stack less that of the stack without the edit. Contributions of edits that
compose on the same light do not add up to the whole difference.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np

from icheat_usd.edits import operations
from icheat_usd.edits.binding import bind
from icheat_usd.edits.model import Blend, Edit, EditStack, Value
from icheat_usd.edits.operations.base import Level
from icheat_usd.errors import EditError
from icheat_usd.image.film import Film
from icheat_usd.relight import Relighter, build_relighter
from icheat_usd.samples import ViewSamples, gather_samples, view_samples
from icheat_usd.samples.develop import develop
from icheat_usd.scene import F64
from icheat_usd.session.aovs import names_of
from icheat_usd.session.document import Session
from icheat_usd.stage.description import EditDescription, describe_edit
from icheat_usd.transport import build_bounces, build_transport, light_cells

Color = tuple[float, float, float]

#: Camera samples and gather rays of the one pixel: so few points that each can have many rays.
PIXEL_SAMPLES, PIXEL_RAYS = 16, 1024

#: Caster surfaces whose share is computed, those that send the most unedited light first.
_CANDIDATES = 24

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class CasterShare:
    """Light that an edit changes because of one caster."""

    path: str
    change: Color


@dataclass(frozen=True)
class EditShare:
    """What one edit does to a pixel."""

    edit: str  #: path
    operation: str
    change: Color  #: radiance with the whole stack, less that without this edit
    mask: float  #: mean receiver mask of what the pixel shows, 0..1
    casters: tuple[CasterShare, ...]  #: by changed light, largest first
    layers: Mapping[str, tuple[object, str]]  #: value and the layer that decides it, by name; authored ones
    note: str = ""  #: why it takes no part: "muted", "amount 0", "the stack is off"


@dataclass(frozen=True)
class PixelExplanation:
    """Radiance is scene-linear Rec.709, of the indirect light."""

    x: int
    y: int
    width: int
    height: int
    camera: str
    surfaces: tuple[str, ...]  #: what the pixel shows, most of it first
    direct: Color
    indirect: Color
    indirect_edited: Color
    edits: tuple[EditShare, ...]  #: in stack order

    @property
    def touching(self) -> tuple[EditShare, ...]:
        return tuple(share for share in self.edits if any(share.change))


def explain_pixel(session: Session, x: int, y: int, *, n_casters: int = 5, rays: int = PIXEL_RAYS) -> PixelExplanation:
    """Light one pixel with and without each edit, at the session's quality; only that pixel's light is computed.

    Parameters
    ----------
    x, y : int
        Pixel from the top left, 0 first.
    n_casters : int
        Most casters to name for an edit.
    rays : int
        Gather rays of each of the pixel's samples.

    Raises
    ------
    EditError
        The image has no such pixel.
    """
    camera = session.snapshot.camera
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        size = f"{camera.width} x {camera.height} pixels, from 0 0 to {camera.width - 1} {camera.height - 1}"
        raise EditError(f"there is no pixel {x} {y}: the image has {size}")
    stack = session.stack
    shares: dict[str, EditShare] = {}
    pixel = y * camera.width + x
    view = view_samples(
        session.snapshot,
        session.tracer,
        samples_per_pixel=max(PIXEL_SAMPLES, session.quality.samples_per_pixel),
        seed=session.quality.seed,
        pixels=(pixel, pixel + 1),
    )
    lit = _PixelLight(session, view, pixel, rays) if view.n else None
    base = lit.light(stack) if lit else np.zeros((3, 3))
    for edit in stack.active if lit else ():
        assert lit is not None
        change = base[2] - lit.light(_without(stack, edit))[2]
        casters = lit.casters(stack, edit, n_casters, change) if change.any() else ()
        shares[edit.path] = _share(session, edit, _rgb(change), lit.mask(edit), casters, True)
    none = (0.0, 0.0, 0.0), 0.0, ()
    edits = tuple(shares.get(edit.path) or _share(session, edit, *none, stack.enabled) for edit in stack.edits)
    return PixelExplanation(
        x,
        y,
        camera.width,
        camera.height,
        camera.path,
        _surfaces(session, view),
        _rgb(base[0]),
        _rgb(base[1]),
        _rgb(base[2]),
        edits,
    )


class _PixelLight:
    """All that reaches the view samples of one pixel."""

    def __init__(self, session: Session, view: ViewSamples, pixel: int, rays: int) -> None:
        self.session, self.view, self.pixel = session, view, pixel
        self.relighter = _relighter(session, view, rays)

    def light(self, stack: EditStack) -> F64:
        """Direct, unedited indirect and edited indirect light of the pixel: (3, 3)."""
        relit = self.relighter.relight(bind(stack, self.session.snapshot))
        window = (self.pixel, self.pixel + 1)
        return np.concatenate([develop(self.view, values, window) for values in relit])

    def mask(self, edit: Edit) -> float:
        """Mean receiver mask, keys weighted as they are, samples by how much of the pixel they are."""
        field = bind(EditStack("", (edit,)), self.session.snapshot)
        if field.is_identity:  # It rests at this time: its key is blocked, or its lights are out.
            return 0.0
        weights = np.array(field.edits[0].key_weights, np.float64)
        of_sample = weights @ field.receiver_masks(self.view.points).astype(np.float64)
        part = self.view.throughput.astype(np.float64) @ _LUMINANCE
        return float(of_sample @ part / max(float(part.sum()), 1e-30))

    def casters(self, stack: EditStack, edit: Edit, n: int, change: F64) -> tuple[CasterShare, ...]:
        """What of an edit's change is due to each caster, the largest first.

        An edit of pairs is applied to each caster alone. One of the light of all casters together changes all of it
        by one factor, so each has as much of the change as it has of the light. One of all light has no casters.
        """
        operation = operations.find(edit.operation)
        if operation is not None and operation.level is Level.VIEW:
            return ()
        measured, factor = edit, np.ones(3)
        if operation is not None and operation.level is Level.AGGREGATE:
            measured = _doubling(edit)
        without = self.light(_without(stack, edit))[2]
        if measured is not edit:
            light = self.light(_with(stack, edit, measured))[2] - without
            factor = np.divide(change, light, out=np.zeros(3), where=light > 0)
        found = []
        for path in self._brightest(edit):
            alone = replace(measured, casters=replace(edit.casters, paths=edit.casters.paths & {path}))
            part = factor * (self.light(_with(stack, edit, alone))[2] - without)
            if part.any():
                found.append(CasterShare(path, _rgb(part)))
        return tuple(sorted(found, key=lambda share: -np.abs(share.change) @ _LUMINANCE)[:n])

    def _brightest(self, edit: Edit) -> list[str]:
        """Casters of the edit by the light that they could send here, edited or not."""
        relighter, snapshot = self.relighter, self.session.snapshot
        weight = np.zeros(relighter.gather.n, np.float64)
        for lobe in relighter.transport.lobes:
            weight += np.bincount(lobe.rows.indices, lobe.rows.weights, relighter.gather.n)
        light = relighter.radiance().astype(np.float64) @ _LUMINANCE
        # Dark casters may emit by an edit, and hidden ones may send light through occluders: they come last.
        share = (weight + 1e-6 * relighter.gather.area) * (light + 1e-3 * max(float(light.mean()), 1e-6))
        surface = snapshot.geometry.instance_surface[relighter.gather.points.instance]
        of_surface = np.bincount(surface, share, len(snapshot.surfaces))
        of_path: dict[str, float] = {}
        for row, value in enumerate(of_surface.tolist()):
            path = snapshot.surfaces[row].path
            if path in edit.casters.paths:
                of_path[path] = of_path.get(path, 0.0) + value
        return sorted(of_path, key=lambda path: -of_path[path])[:_CANDIDATES]


def _relighter(session: Session, view: ViewSamples, rays: int) -> Relighter:
    snapshot, tracer, quality, seed = session.snapshot, session.tracer, session.quality, session.quality.seed
    progress = session.progress
    gather = gather_samples(snapshot, tracer, view, n=quality.n_gather, seed=seed)
    transport = build_transport(snapshot, tracer, view, gather, rays_per_row=rays, seed=seed, progress=progress)
    bounces = build_bounces(
        snapshot, tracer, gather, rays_per_row=quality.rays_per_bounce_row, seed=seed, progress=progress
    )
    cells = light_cells(
        snapshot,
        tracer,
        gather,
        bounces,
        n_bounces=quality.n_bounces,
        light_samples=quality.light_samples,
        seed=seed,
        progress=progress,
    )
    samples = quality.light_samples
    return build_relighter(
        snapshot, tracer, view, gather, transport, cells, light_samples=samples, seed=seed, progress=progress
    )


def _without(stack: EditStack, edit: Edit) -> EditStack:
    return replace(stack, edits=tuple(other for other in stack.edits if other is not edit))


def _with(stack: EditStack, edit: Edit, other: Edit) -> EditStack:
    """The stack with another edit in the place of one of its own."""
    return replace(stack, edits=tuple(other if e is edit else e for e in stack.edits))


def _doubling(edit: Edit) -> Edit:
    """An edit that adds the light of the casters once more, where the given one changes it."""
    gain: dict[str, Value] = {"gain": 2.0}
    payloads = [key.payload and replace(key.payload, operation="scale", parameters=gain) for key in edit.keys]
    keys = tuple(replace(key, payload=payload) for key, payload in zip(edit.keys, payloads, strict=True))
    return replace(edit, operation="scale", parameters=gain, keys=keys, amount=1.0, blend=Blend.COMPOSE)


def _share(
    session: Session, edit: Edit, change: Color, mask: float, casters: tuple[CasterShare, ...], is_on: bool
) -> EditShare:
    described = describe_edit(session.stage, edit.path, session.frame)
    note = "" if edit.is_active else ("muted" if not edit.enabled else "amount 0")
    note = note if is_on else "the stack is off"
    return EditShare(edit.path, edit.operation, change, mask, casters, _deciding(described), note)


def _deciding(described: EditDescription) -> dict[str, tuple[object, str]]:
    values = {
        "operation": described.operation,
        "amount": described.amount,
        "blend": described.blend,
        "enabled": described.enabled,
        **described.parameters,
    }
    return {name: (value.value, value.layer) for name, value in values.items() if value.layer}


def _surfaces(session: Session, view: ViewSamples) -> tuple[str, ...]:
    snapshot = session.snapshot
    part: dict[str, float] = {}
    weights = view.throughput.astype(np.float64) @ _LUMINANCE
    for instance, weight in zip(view.points.instance.tolist(), weights.tolist(), strict=True):
        path = snapshot.surfaces[int(snapshot.geometry.instance_surface[instance])].path
        part[path] = part.get(path, 0.0) + weight
    return tuple(sorted(part, key=lambda path: -part[path]))


def _rgb(values: F64) -> Color:
    red, green, blue = (float(value) for value in values)
    return red, green, blue


# --------------------------------------------------------------------------- images


def contribution_film(session: Session) -> Film:
    """What each active edit changes, everywhere.

    Returns
    -------
    Film
        Layers `beauty`, `indirect`, `indirect_edited`, and for each edit ``edit.<name>``: the indirect light with
        the whole stack less that without the edit, negative where the edit takes light away.
    """
    stack, relighter, view = session.stack, session.relighter, session.view
    relit = relighter.relight(bind(stack, session.snapshot))
    shape = (view.height, view.width, 3)

    def image(values: F64) -> np.ndarray:
        return np.ascontiguousarray(values.reshape(shape), np.float32)

    background = view.background.astype(np.float64)
    layers = {
        "beauty": image(develop(view, relit.direct) + develop(view, relit.indirect_edited) + background),
        "indirect": image(develop(view, relit.indirect)),
        "indirect_edited": image(develop(view, relit.indirect_edited)),
    }
    for edit, name in zip(stack.active, names_of([edit.path for edit in stack.active]), strict=True):
        without = relighter.relight(bind(_without(stack, edit), session.snapshot)).indirect_edited
        layers[f"edit.{name}"] = image(develop(view, relit.indirect_edited - without))
    return Film(view.width, view.height, layers, session.metadata("explain", stack, asdict(session.quality)))
