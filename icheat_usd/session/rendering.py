"""Final frames as files: made once, and made again only when something that decides them has changed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from icheat_usd.edits.binding import bind
from icheat_usd.edits.model import EditStack
from icheat_usd.errors import ImageError
from icheat_usd.final_gather import (
    Extras,
    FinalGather,
    GatherSettings,
    denoised,
    final_gather,
    weighted_gather,
    with_denoising,
)
from icheat_usd.image.colour import configuration_id
from icheat_usd.image.denoise import denoiser
from icheat_usd.image.exr import write_exr
from icheat_usd.image.film import Film
from icheat_usd.image.png import write_pixels, write_png
from icheat_usd.image.record_map import record_map
from icheat_usd.image.replacing import check_writable, remove_abandoned
from icheat_usd.image.whole import whole_metadata
from icheat_usd.session import aovs, layer_names
from icheat_usd.session.content_keys import digest, library_version, snapshot_key
from icheat_usd.session.films import image_metadata

if TYPE_CHECKING:
    from icheat_usd.session.document import Session

#: Name of the metadata that say what a file was made of.
INPUTS = "inputs"


@dataclass(frozen=True)
class Output:
    """A file to write of a frame."""

    path: Path  #: .exr or .png
    layers: tuple[layer_names.Layer, ...]  #: families of layers are those that the frame has; a .png shows the first
    half: frozenset[str] = frozenset()  #: names of layers that an .exr stores with 16 bits
    multipart: bool = True  #: an .exr has a part for each layer
    view: str | None = None  #: OCIO view of a .png; None is the display's own
    exposure: float = 0.0  #: of a .png, stops
    product: str = ""  #: prim that asks for it
    is_map: bool = False  #: a .png that shows the first layer, records of cached light, over the second one


@dataclass(frozen=True)
class Written:
    """What became of the outputs of a frame."""

    width: int
    height: int
    metadata: dict[str, str]
    kept: tuple[Path, ...]  #: were there already, made of the same


def render_film(session: Session, settings: GatherSettings, layers: Sequence[layer_names.Layer]) -> Film:
    """One frame by final gathering.

    Raises
    ------
    ImageError
        A layer is of a light or an edit that is not there at this frame; or the denoiser is not there.
    """
    if settings.denoise:
        denoiser()  # before hours of work
    if not settings.is_cached and any(layer.source == "records" for layer in layers):
        raise ImageError(f"the {settings.method} method places no records; leave them out, or choose the cached method")
    stack = session.stack
    scene = aovs.layer_scene(session.snapshot, stack)
    members = aovs.expanded(layers, scene)
    extras = aovs.needed(members, scene)
    edits = [edit.path for edit in stack.active]
    if settings.denoise:
        extras = with_denoising(extras, edits)
    result = weighted_gather(
        (weight, gather_frame(moment, effort, extras)) for weight, moment, effort in _moments(session, settings)
    )
    if settings.denoise:
        result = denoised(result, edits, progress=session.progress)
    return aovs.make_film(result, members, scene, session.snapshot, _metadata(session, settings, stack))


def write_outputs(
    session: Session, settings: GatherSettings, outputs: Sequence[Output], *, force: bool = False
) -> Written:
    """Render a frame and write its files; those that were made of the same before are left as they are.

    Files hold nothing of when or how long, so that the same inputs make the same bytes.

    Parameters
    ----------
    force : bool
        Write all of them.
    """
    stack, camera = session.stack, session.snapshot.camera
    about = _metadata(session, settings, stack)
    frame = _frame_key(session, settings, about)
    for output in outputs:
        remove_abandoned(output.path)
    keys = {output.path: digest(frame, _content(output)) for output in outputs}
    kept = tuple(path for path, key in keys.items() if not force and _was_made_of(path, key))
    wanted = [output for output in outputs if output.path not in kept]
    if wanted:
        for output in wanted:
            check_writable(output.path)
        sources = dict.fromkeys(layer.source for output in wanted for layer in output.layers)
        scene = aovs.layer_scene(session.snapshot, stack)
        # Before hours of work: names that collide, or that this frame does not have.
        members = {output.path: aovs.expanded(output.layers, scene) for output in wanted}
        film = render_film(
            session, settings, [layer_names.Layer(source, layer_names.layer_name(source)) for source in sources]
        )
        for output in wanted:
            _write(film, output, members[output.path], keys[output.path])
    return Written(camera.width, camera.height, about, kept)


def _moments(session: Session, settings: GatherSettings) -> Iterator[tuple[float, Session, GatherSettings]]:
    """Moments that make up a frame: weights that sum to 1, what is there then, and the work for each."""
    from icheat_usd.session.shutter import moments

    for moment in moments(session, settings.samples_per_pixel, settings.edge_samples):
        effort = replace(
            settings,
            samples_per_pixel=moment.samples_per_pixel,
            edge_samples=moment.edge_samples,
            first_sample=moment.first_sample,
            first_edge_sample=moment.first_edge_sample,
        )
        yield moment.weight, moment.session, effort


def gather_frame(session: Session, settings: GatherSettings, extras: Extras, *, is_kept: bool = False) -> FinalGather:
    """The frame at one moment."""
    field = bind(session.stack, session.snapshot)
    gather, radiance, sampler = None, None, None
    if settings.uses_cells or field.uses_incident or field.has_offset:
        light = session.photon_light if settings.bounces == "photons" else session.cell_light
        gather, radiance = session.gather, light.radiance
    if settings.method == "gathered":
        sampler = session.light_sampler  # a third of a second less, and direct light hardly noisier
    return final_gather(
        session.snapshot,
        session.tracer,
        field,
        settings=settings,
        gather=gather,
        gather_radiance=radiance,
        sampler=sampler,
        extras=extras,
        is_kept=is_kept,
        progress=session.progress,
    )


def _metadata(session: Session, settings: GatherSettings, stack: EditStack) -> dict[str, str]:
    return image_metadata(session.snapshot, "final gather", stack, asdict(settings))


def _frame_key(session: Session, settings: GatherSettings, about: dict[str, str]) -> str:
    """Digest of everything that decides a frame: code, scene, edits with their payloads, settings, what files say."""
    moments = [
        (weight, snapshot_key(moment.snapshot, moment.engine), moment.stack.digest, asdict(moment.quality), effort)
        for weight, moment, effort in _moments(session, settings)
    ]
    denoiser_version = library_version("pyoidn") if settings.denoise else ""
    return digest("final frame", moments, about, denoiser_version)


def _content(output: Output) -> tuple[object, ...]:
    """What of an output decides its bytes."""
    layers = [(layer.source, layer.name) for layer in output.layers]
    form = output.path.suffix.lower()
    if output.is_map:
        return form, layers, "map of records"
    if form == ".png":
        return form, layers[:1], output.view, output.exposure, configuration_id()
    return form, layers, sorted(output.half), output.multipart, output.product


def _was_made_of(path: Path, key: str) -> bool:
    """Whether a file is there, whole, and of this key."""
    try:
        return path.is_file() and whole_metadata(path).get(INPUTS) == key
    except ImageError:
        return False


def _write(film: Film, output: Output, members: Sequence[layer_names.Layer], key: str) -> None:
    """Write some layers of a film, under the names that the output gives them."""
    described = {text: film.metadata[text] for text in film.metadata if not text.startswith("layer:")}
    layers, mattes = {}, []
    for layer in members:
        usual = layer_names.layer_name(layer.source)
        if usual in film.layers:
            layers[layer.name] = film.layers[usual]
        else:
            mattes += [replace(matte, name=layer.name) for matte in film.mattes if matte.name == usual]
        if f"layer:{usual}" in film.metadata:
            described[f"layer:{layer.name}"] = film.metadata[f"layer:{usual}"]
    described[INPUTS] = key
    if output.product:
        described["product"] = output.product
    part = Film(film.width, film.height, layers, described, tuple(mattes), film.pixel_aspect)
    if output.is_map:
        records, light = (part.layer(layer.name) for layer in members)
        write_pixels(record_map(records, light), output.path, srgb=True, metadata=described)
    elif output.path.suffix.lower() == ".exr":
        write_exr(part, output.path, half=output.half, multipart=output.multipart)
    else:
        write_png(part, output.path, layer=members[0].name, view=output.view, exposure=output.exposure)
