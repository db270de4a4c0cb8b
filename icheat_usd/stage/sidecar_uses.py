"""Which sidecars layers name: every spec of every layer, composed or not.

Layers are read one by one, not as a stage: what a variant that is not
selected, a muted layer or an inactive prim names is named all the same.
"""

from __future__ import annotations

import fnmatch
import glob
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from pxr import Ar, Sdf, Tf

from icheat_usd.errors import EditError, StageError
from icheat_usd.stage import schema
from icheat_usd.stage.layers import asset_path, remember_layer, save_layer
from icheat_usd.stage.opening import quiet_usd

LAYER_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
SIDECAR_SUFFIX = ".icheat.h5"

#: Folder beside sidecars that collected ones are moved to; nothing in it is read.
TRASH = ".icheat-trash"

_NO_ASSETS = ("default", "timeSamples", "documentation", "comment", "subLayerOffsets")
_ASSET_TYPES = ("asset", "asset[]", "string", "string[]", "token", "token[]")


@dataclass(frozen=True)
class SidecarUses:
    """What one layer file, or several, name."""

    layers: Mapping[str, str]  #: files read, by real path, and what their state was
    files: frozenset[str]  #: sidecars, by real path, whether they exist or not
    patterns: frozenset[str]  #: sidecars whose name has expression variables in it, as glob patterns
    digests: frozenset[str]  #: payloads
    problems: tuple[str, ...]  #: what could not be read, so that more may be named than is listed here

    @property
    def is_current(self) -> bool:
        """Whether no layer file has changed since it was read."""
        return all(_state(layer) == state for layer, state in self.layers.items())

    def names(self, file: str) -> bool:
        """Whether a layer names this sidecar, or may."""
        real = os.path.realpath(file)
        return real in self.files or any(glob_matches(pattern, real) for pattern in self.patterns)


def layers_below(root: str) -> list[str]:
    """A layer file itself, or all layer files in a folder and below, sorted; the trash is left out.

    Raises
    ------
    StageError
        There is no such file or folder.
    """
    if os.path.isfile(root):
        return [root]
    if not os.path.isdir(root):
        raise StageError(f"{root} does not exist; name a layer or a folder of layers")

    def unreadable(problem: OSError) -> None:
        raise StageError(f"{problem.filename} cannot be listed ({problem.strerror}); check its permissions")

    found, seen = [], set()
    # Linked folders too: what their layers name must stay. A link may lead back up.
    for folder, folders, names in os.walk(root, onerror=unreadable, followlinks=True):
        real = os.path.realpath(folder)
        folders[:] = [] if real in seen else sorted(name for name in folders if name != TRASH)
        seen.add(real)
        found += [os.path.join(folder, name) for name in sorted(names) if name.lower().endswith(LAYER_SUFFIXES)]
    return found


def sidecar_uses(layers: Iterable[str], *, follow: bool = True, ignore: Iterable[str] = ()) -> SidecarUses:
    """What these layers name, and, with `follow`, what the layers that they refer to name.

    A layer that cannot be read is a problem in the result, not an error,
    unless its path is like one of the patterns (as in a shell) in `ignore`.
    """
    waiting = [(os.path.realpath(layer), "") for layer in layers]
    ignored = tuple(os.path.abspath(pattern) for pattern in ignore)
    seen: dict[str, str] = {}
    files: set[str] = set()
    patterns: set[str] = set()
    digests: set[str] = set()
    problems: list[str] = []
    with quiet_usd():
        while waiting:
            identifier, because = waiting.pop()
            if identifier in seen:
                continue
            seen[identifier] = _state(identifier)
            layer, contents = _open(identifier)
            if layer is None:
                if not any(fnmatch.fnmatch(identifier, pattern) for pattern in ignored):
                    what = "cannot be read as a layer" if seen[identifier] else "does not exist"
                    problems.append(f"{identifier} {what}" + (f", and {because} refers to it" if because else ""))
                continue
            for content in contents:
                digests |= _digests(content)
            for path in sorted(set().union(*map(_assets, contents))):
                try:
                    places, is_pattern = _places(layer, path)
                except EditError as problem:
                    problems.append(f"{identifier}: {problem}")
                    continue
                if SIDECAR_SUFFIX in path:
                    (patterns if is_pattern else files).update(places)
                elif follow and _is_layer(path):
                    reached = [file for place in places for file in glob.glob(place)] if is_pattern else places
                    if not reached:
                        problems.append(f"{identifier}: no file is like {path}")
                    waiting += [(place, identifier) for place in reached]
    return SidecarUses(seen, frozenset(files), frozenset(patterns), frozenset(digests), tuple(problems))


def _open(identifier: str) -> tuple[Sdf.Layer | None, list[Sdf.Layer]]:
    """A layer to resolve paths with, and what it says: in memory, where it is open already, and in its file."""
    try:
        known = Sdf.Layer.Find(identifier)
        if not known:
            opened = Sdf.Layer.FindOrOpen(identifier)
            return (opened, [opened]) if opened else (None, [])
        contents = [known]
        if os.path.isfile(identifier):
            contents.append(Sdf.Layer.OpenAsAnonymous(identifier))
        return (known, contents) if all(contents) else (None, [])
    except Tf.ErrorException:
        return None, []


def _state(file: str) -> str:
    try:
        state = os.stat(file)
    except OSError:
        return ""  # in a package, or gone
    return f"{state.st_ino}:{state.st_size}:{state.st_mtime_ns}"


def glob_matches(pattern: str, file: str) -> bool:
    """Whether a file's path is one that a pattern of `SidecarUses` may stand for."""
    parts = (".*" if part == "*" else re.escape(part) for part in re.split(r"(\*)", pattern))
    return re.fullmatch("".join(parts), file) is not None


def repoint_layer(file: str, sidecar: str, replaced: Iterable[str]) -> int:
    """Make one layer name `sidecar` wherever it names one of the `replaced` files, and save it.

    Returns
    -------
    int
        How many values changed. Digests stay as they are.

    Raises
    ------
    EditError
        The layer cannot be read or written, or its file changed meanwhile.
    """
    with quiet_usd():
        try:
            layer = Sdf.Layer.FindOrOpen(file)
        except Tf.ErrorException:
            layer = None
    if not layer or not layer.permissionToEdit:
        raise EditError(f"{file} cannot be edited; name a layer file that may be written")
    remember_layer(layer)
    old = {os.path.realpath(name) for name in replaced}
    new = Sdf.AssetPath(asset_path(layer, sidecar))
    changed = 0
    for path in _property_paths(layer):
        spec = layer.GetAttributeAtPath(path)
        if not spec or path.name != schema.FILE_PATH:
            continue
        if _stands_for(layer, spec.default, old):
            spec.default = new
            changed += 1
        for time in layer.ListTimeSamplesForPath(path):
            if _stands_for(layer, layer.QueryTimeSample(path, time), old):
                layer.SetTimeSample(path, time, new)
                changed += 1
    if changed:
        save_layer(layer)
    return changed


def _stands_for(layer: Sdf.Layer, value: Any, files: set[str]) -> bool:
    if not isinstance(value, Sdf.AssetPath) or not value.path:
        return False
    places, is_pattern = _places(layer, value.path)
    return not is_pattern and any(place in files for place in places)


def _digests(layer: Sdf.Layer) -> set[str]:
    found: set[str] = set()
    for path in _property_paths(layer):
        if path.name == schema.PAYLOAD:
            spec = layer.GetAttributeAtPath(path)
            values = [spec.default] if spec else []
            values += [layer.QueryTimeSample(path, time) for time in layer.ListTimeSamplesForPath(path)]
            found |= {str(value) for value in values if isinstance(value, str) and value}
    return found


def _assets(layer: Sdf.Layer) -> set[str]:
    """Every asset path in a layer, and every text that may name a layer or a sidecar."""
    found = set(layer.GetCompositionAssetDependencies())
    paths: list[Sdf.Path] = []
    layer.Traverse(Sdf.Path.absoluteRootPath, paths.append)
    for path in paths:
        spec = layer.pseudoRoot if path == Sdf.Path.absoluteRootPath else layer.GetObjectAtPath(path)
        if not spec:
            continue
        if isinstance(spec, Sdf.AttributeSpec):
            if str(spec.typeName) in _ASSET_TYPES:
                found.update(_texts(spec.default))
                for time in layer.ListTimeSamplesForPath(path):
                    found.update(_texts(layer.QueryTimeSample(path, time)))
        for key in spec.ListInfoKeys():
            if key not in _NO_ASSETS:
                with suppress(TypeError):  # a type that Python has no form of; asset paths and text have one
                    found.update(_texts(spec.GetInfo(key)))
    return {path for path in found if path and (SIDECAR_SUFFIX in path or _is_layer(path))}


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, Sdf.AssetPath):
        yield value.path
    elif isinstance(value, (Sdf.AssetPathArray, list, tuple)) or type(value).__name__ in ("StringArray", "TokenArray"):
        for item in value:
            yield from _texts(item)
    elif isinstance(value, Sdf.UnregisteredValue):
        yield from _texts(value.value)
    elif isinstance(value, dict):
        for item in value.values():
            yield from _texts(item)


def _is_layer(path: str) -> bool:
    bare = path.strip("`\"'").partition("[")[0].partition(":SDF_FORMAT_ARGS:")[0]
    return bare.lower().endswith(LAYER_SUFFIXES)


def _places(layer: Sdf.Layer, path: str) -> tuple[list[str], bool]:
    """Where an asset path points to from this layer, by real path, and whether these are patterns."""
    is_pattern = False
    if Sdf.VariableExpression.IsExpression(path):
        literal = re.fullmatch(r"`\s*([\"'])(.*)\1\s*`", path)
        if literal is None:
            raise EditError(f"what {path} stands for depends on the stage")
        path, is_pattern = re.sub(r"\$\{[^}]*\}", "*", literal[2]), True
    elif "#" in path:
        path, is_pattern = re.sub(r"#+", "*", path), True  # clips by template
    path = path.partition(":SDF_FORMAT_ARGS:")[0]
    anchored = Sdf.ComputeAssetPathRelativeToLayer(layer, path)
    if not is_pattern:
        with quiet_usd():
            resolved = str(Ar.GetResolver().Resolve(anchored))
        anchored = resolved or anchored
    if Ar.IsPackageRelativePath(anchored):
        return [anchored], is_pattern
    if is_pattern and not os.path.isabs(anchored):
        anchored = os.path.join(os.path.dirname(layer.realPath), anchored)
    return [os.path.realpath(anchored)], is_pattern


def _property_paths(layer: Sdf.Layer) -> list[Sdf.Path]:
    paths: list[Sdf.Path] = []
    layer.Traverse(Sdf.Path.absoluteRootPath, paths.append)
    return [path for path in paths if path.IsPropertyPath()]
