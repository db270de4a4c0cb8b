"""One layer of a stage as the place that opinions are written to, and its file.

A function that names a layer takes its identifier, path or file name, the layer itself, or ``"session"``; it has to be
in the stage's own layer stack.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress

from pxr import Ar, Sdf, Tf, Usd

from icheat_usd.errors import EditError, StageError
from icheat_usd.stage import schema
from icheat_usd.stage.keys import strongest_opinion
from icheat_usd.stage.locking import locked
from icheat_usd.stage.stacks import EditFinding, edit_prim
from icheat_usd.stage.variants import selected_variant, variant_target

#: Layers whose file is larger than this are not compared with it before the first edit.
_MAX_COMPARED_BYTES = 8 << 20
_seen_on_disk: dict[str, str] = {}


def find_layer(stage: Usd.Stage, layer: str | Sdf.Layer) -> Sdf.Layer:
    """The layer to write to, checked to be one that this stage can write to.

    Raises
    ------
    EditError
        It is not in the stage's own layer stack, several match, it may not be edited, or its file changed on disk
        since it was read.
    """
    layers = stage.GetLayerStack(includeSessionLayers=True)
    if isinstance(layer, Sdf.Layer):
        matches = [candidate for candidate in layers if candidate == layer]
    elif layer == "session":
        matches = [stage.GetSessionLayer()] if stage.GetSessionLayer() else []
    else:
        exact = {layer, os.path.realpath(layer)}
        matches = [candidate for candidate in layers if {candidate.identifier, candidate.realPath} & exact]
        matches = matches or [candidate for candidate in layers if _file_name(candidate) == layer]
    name = layer.identifier if isinstance(layer, Sdf.Layer) else layer
    if len(matches) != 1:
        known = ", ".join(candidate.identifier for candidate in layers if not candidate.anonymous)
        count = "is not" if not matches else f"matches {len(matches)} layers"
        raise EditError(
            f"layer '{name}' {count} in the layer stack of {stage.GetRootLayer().identifier}, which has {known}; "
            f"name one of them or 'session'"
        )
    if not matches[0].permissionToEdit:
        raise EditError(f"layer '{matches[0].identifier}' may not be edited; name another layer")
    if matches[0].GetFileFormat().IsPackage() or Ar.IsPackageRelativePath(matches[0].identifier):
        raise EditError(f"layer '{matches[0].identifier}' lies in a package, which is read-only; write to one over it")
    remember_layer(matches[0])
    return matches[0]


def _file_name(layer: Sdf.Layer) -> str:
    return os.path.basename(layer.realPath or layer.identifier)


def remember_layer(layer: Sdf.Layer) -> None:
    """Note what a layer's file looks like now, so that `save_layer` can tell whether someone else wrote it.

    Call it when a stage has just been opened; the functions here call it before they first write to a layer.

    Raises
    ------
    EditError
        The layer has no unsaved changes, and its file says something else than it does.
    """
    on_disk = _on_disk(layer)
    if not on_disk or (layer.dirty and layer.identifier in _seen_on_disk):
        return
    if not layer.dirty and _seen_on_disk.get(layer.identifier) != on_disk and not _says_what_its_file_says(layer):
        raise _changed(layer)
    _seen_on_disk[layer.identifier] = on_disk


def _on_disk(layer: Sdf.Layer) -> str:
    try:
        state = os.stat(layer.realPath)
    except OSError:
        return ""
    return f"{state.st_ino}:{state.st_size}:{state.st_mtime_ns}"


def _says_what_its_file_says(layer: Sdf.Layer) -> bool:
    if os.path.getsize(layer.realPath) > _MAX_COMPARED_BYTES:
        return True
    fresh = Sdf.Layer.OpenAsAnonymous(layer.realPath)
    return bool(fresh) and fresh.ExportToString() == layer.ExportToString()


def _changed(layer: Sdf.Layer) -> EditError:
    return EditError(
        f"{layer.realPath} changed on disk since it was read, so saving would lose that change; reload it first"
    )


def save_layer(layer: Sdf.Layer) -> None:
    """Save a layer, unless someone else wrote its file since it was read.

    Raises
    ------
    EditError
        The layer has no file, its file changed on disk, or may not be written.
    """
    if layer.anonymous:
        raise EditError(f"layer '{layer.identifier}' has no file; export it or author in a layer that has one")
    with locked(layer.realPath):
        known = _seen_on_disk.get(layer.identifier)
        if known is not None and _on_disk(layer) not in ("", known):
            raise _changed(layer)
        try:
            saved = layer.Save()
        except Tf.ErrorException as error:
            raise EditError(
                f"{layer.realPath} cannot be saved ({_first_line(error)}); check its permissions"
            ) from error
        if not saved:
            raise EditError(f"{layer.realPath} cannot be saved; check its permissions")
        _flush(layer.realPath)
        _seen_on_disk[layer.identifier] = _on_disk(layer)


def _flush(file: str) -> None:
    """Have a saved file on the disk before anything counts on it: USD writes and renames, but does not flush."""
    for path in (file, os.path.dirname(file)):
        with suppress(OSError):  # Some file systems cannot flush a folder.
            descriptor = os.open(path, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)


def _first_line(error: Tf.ErrorException) -> str:
    line = next((line.strip() for line in str(error).splitlines() if line.strip()), "unknown reason")
    return line.partition(" : ")[2].strip("'") or line


@contextmanager
def writing(
    stage: Usd.Stage, layer: str | Sdf.Layer, path: str | Sdf.Path, variant: tuple[str, str] | None = None
) -> Iterator[Sdf.Layer]:
    """Write opinions at or below `path` to a layer, times mapped into it.

    With `variant` (set, variant) they are written into that variant of the nearest prim at or above `path` that has
    the set, and it is selected meanwhile. USD's refusals become errors; after any error the layer says what it said
    before.
    """
    schema.require_registered()
    target = find_layer(stage, layer)
    with selected_variant(stage, str(path), variant) as place:
        path = Sdf.Path(path) if place is None else place.GetPrimPath()
        before = Sdf.Layer.CreateAnonymous()
        existed = bool(target.GetPrimAtPath(path))
        if existed:
            Sdf.CreatePrimInLayer(before, path)
            Sdf.CopySpec(target, path, before, path)
        first_new = next((prefix for prefix in path.GetPrefixes() if not target.GetPrimAtPath(prefix)), path)
        try:
            local = stage.GetEditTargetForLocalLayer(target)
            with Usd.EditContext(stage, local if place is None else variant_target(stage, target, place)):
                yield target
        except BaseException as error:
            if existed:
                Sdf.CopySpec(before, path, target, path)
            elif target.GetPrimAtPath(first_new):
                siblings = target.GetPrimAtPath(first_new.GetParentPath()).nameChildren
                del siblings[first_new.name]
            if isinstance(error, Tf.ErrorException):
                raise EditError(f"{target.identifier}: USD refused the edit ({_first_line(error)})") from error
            raise


@contextmanager
def saving(stage: Usd.Stage, layer: str | Sdf.Layer) -> Iterator[None]:
    """Write to a layer and save it if it has a file; after any error the layer says what it said before."""
    target = find_layer(stage, layer)
    before = Sdf.Layer.CreateAnonymous()
    before.TransferContent(target)
    try:
        yield
        if not target.anonymous:
            save_layer(target)
    except Exception:
        target.TransferContent(before)
        raise


def spec_path(stage: Usd.Stage, path: Sdf.Path) -> Sdf.Path:
    """Where opinions on a stage's path lie in the layer that is written to: in a variant, if that is written to."""
    return stage.GetEditTarget().MapToSpecPath(path)


def reload_layer(layer: Sdf.Layer) -> None:
    """Read a layer's file again, dropping unsaved changes.

    Raises
    ------
    StageError
        The file cannot be read.
    """
    if not layer.Reload(force=True):
        raise StageError(f"{layer.identifier} cannot be read again; check that the file exists")
    _seen_on_disk[layer.identifier] = _on_disk(layer)


def asset_path(layer: Sdf.Layer, file: str) -> str:
    """`file` as the layer should say it: relative to its own file where it has one."""
    if "://" in file or file.startswith("anon:"):
        return file
    absolute = os.path.abspath(file)
    if layer.anonymous or not layer.realPath or Ar.IsPackageRelativePath(file):
        return absolute
    relative = os.path.relpath(absolute, os.path.dirname(layer.realPath)).replace(os.sep, "/")
    return relative if relative.startswith("../") else f"./{relative}"


def writable_edit(stage: Usd.Stage, edit: str) -> Usd.Prim:
    prim = edit_prim(stage, edit)
    refuse_instances(stage, prim.GetPath())
    return prim


def refuse_instances(stage: Usd.Stage, path: Sdf.Path) -> None:
    for ancestor in path.GetPrefixes():
        prim = stage.GetPrimAtPath(ancestor)
        if prim and (prim.IsInstance() or prim.IsInstanceProxy() or prim.IsInPrototype()):
            raise EditError(f"{path} lies in the instance {ancestor}, whose contents are shared; place it outside")


def overridden_opinions(
    prim: Usd.Prim, layer: Sdf.Layer, names: Iterable[str], time: float | None
) -> tuple[EditFinding, ...]:
    findings = []
    for name in names:
        opinion = strongest_opinion(prim.GetAttribute(name), time)
        here = spec_path(prim.GetStage(), prim.GetPath().AppendProperty(name))
        if opinion is not None and (opinion.layer != layer or opinion.path != here):
            place = "" if opinion.layer != layer else f" at {opinion.path}"
            message = f"authored in {layer.identifier}, but {opinion.layer.identifier}{place} is stronger and decides"
            findings.append(EditFinding(str(prim.GetPath()), name, message))
        elif opinion is not None and opinion.source != "default" and time is None:
            message = f"authored without a time in {layer.identifier}, where time samples or a spline decide"
            findings.append(EditFinding(str(prim.GetPath()), name, message))
    return tuple(findings)
