"""Keeping sidecars in order: pack, publish, upgrade, collect what nobody names, and say which payload came when.

Nothing here changes a sidecar: it makes new ones, and moves unused ones into a
trash folder beside them. A layer is written only where its name was given.
"""

from __future__ import annotations

import json
import os
import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from icheat_usd import sidecar
from icheat_usd.errors import EditError, SidecarError, StageError
from icheat_usd.session.origin import history_entry
from icheat_usd.sidecar import SUFFIX
from icheat_usd.sidecar.writer import write_text_beside
from icheat_usd.stage.sidecar_uses import (
    LAYER_SUFFIXES,
    TRASH,
    SidecarUses,
    layers_below,
    repoint_layer,
    sidecar_uses,
)

MANIFEST_SUFFIX = ".icheat.json"

#: `collect` leaves younger files alone: their layer may not be saved yet.
MIN_AGE_HOURS = 24.0


@dataclass(frozen=True)
class Packed:
    """A file that was made from others."""

    file: str
    payloads: tuple[str, ...]
    sources: tuple[str, ...]
    repointed: Mapping[str, int]  #: by layer, how many values now name the file


@dataclass(frozen=True)
class Unnamed:
    """A sidecar that no layer names, or that has payloads that none names."""

    file: str
    n_bytes: int
    payloads: tuple[str, ...]  #: those that no layer names
    moved_to: str = ""


@dataclass(frozen=True)
class Collection:
    """What `collect` found; `problems` say why nothing may be moved."""

    layers: int
    sidecars: int
    unnamed: tuple[Unnamed, ...]
    partly_named: tuple[Unnamed, ...]
    spared: Mapping[str, str]  #: unnamed, and why it stays all the same
    problems: tuple[str, ...]

    @property
    def n_bytes(self) -> int:
        return sum(item.n_bytes for item in self.unnamed)


# Packing and upgrading ------------------------------------------------------------------------------------------------


def pack(
    inputs: Sequence[str], out: str | None, *, layer: str | None = None, why: str = "", published: bool = False
) -> Packed:
    """Merge sidecars, and what layers name, into one new file.

    Parameters
    ----------
    inputs : sequence of str
        Sidecars, and layers: those of a layer count with the payloads that the layer itself names.
    out : str or None
        The file to make; by default the next version beside `layer`, or beside the only input.
    layer : str, optional
        A layer to merge the sidecars of, and to make name the new file; it is saved.

    Raises
    ------
    EditError, SidecarError
        Something cannot be read, verified or written. The layer is then as before.
    """
    inputs = [*inputs, *([layer] if layer is not None and layer not in inputs else [])]
    sources: dict[str, None] = {}
    wanted: set[str] | None = set()
    for name in inputs:
        if name.lower().endswith(LAYER_SUFFIXES):
            uses = uses_of_layer(name)
            sources.update(dict.fromkeys(sorted(uses.files)))
            wanted = wanted if wanted is None else wanted | uses.digests
        else:
            sources[name] = None
            wanted = None  # everything that a sidecar has
    if not sources:
        raise EditError(f"{', '.join(inputs)}: no layer names a sidecar, so there is nothing to pack")
    if out is None and len(inputs) != 1 and layer is None:
        raise SidecarError("several inputs give no name for the new file; name it with --out")
    entry = history_entry(why or "packed")
    beside = out or layer or inputs[0]
    file, payloads = sidecar.pack([*sources], beside, only=wanted, history=entry, published=published)
    repointed = {}
    if layer is not None:
        try:
            repointed[layer] = repoint_layer(layer, str(file), sources)
        except Exception:
            # Not after an interruption: the layer may have been saved already, and then names the file.
            file.unlink(missing_ok=True)
            raise
    return Packed(str(file), tuple(payloads), tuple(sources), repointed)


def uses_of_layer(name: str) -> SidecarUses:
    """What one layer names. Raises `StageError` or `EditError` where that cannot be told for certain."""
    if not os.path.isfile(name):
        raise StageError(f"{name} does not exist; name a layer or a sidecar file")
    uses = sidecar_uses([name], follow=False)
    if uses.problems:
        raise StageError(f"{uses.problems[0]}; repair it first")
    if uses.patterns:
        pattern = sorted(uses.patterns)[0]
        raise EditError(f"{name} names sidecars by expression variables ({pattern}); name the files themselves")
    return uses


def upgrade(files: Sequence[str], out: str | None, *, why: str = "") -> tuple[str, Mapping[str, str]]:
    """Store payloads anew in the newest versions of their elements; old digests stay valid in the new file.

    Parameters
    ----------
    out : str or None
        The file to make; by default the next version beside the only input.

    Returns
    -------
    (str, mapping of str to str)
        The new file, and the new digest of each old one.
    """
    if out is None and len(files) != 1:
        raise SidecarError("several files give no name for the new one; name it with --out")
    beside = out or _beside(files[0])
    file, renamed = sidecar.upgrade(files, beside, history=history_entry(why or "upgraded"))
    return str(file), renamed


def _beside(file: str) -> str:
    """A name whose next version follows that of a sidecar: `shot.v002.icheat.h5` is beside `shot`."""
    stem = os.path.basename(file).removesuffix(SUFFIX)
    head, dot, version = stem.rpartition(".v")
    return os.path.join(os.path.dirname(file), (head if dot and version.isdigit() else stem) + ".usda")


# Collecting what nobody names -----------------------------------------------------------------------------------------


def collect(
    roots: Sequence[str], *, move: bool = False, min_age_hours: float = MIN_AGE_HOURS, ignore: Sequence[str] = ()
) -> Collection:
    """Find sidecars at and below the roots that no layer names, and move them to a trash folder beside them.

    Every layer at, below and reachable from the roots is read, whatever of it
    is composed. Sidecars outside the roots are left alone, because layers that
    were not read may name them; so may layers elsewhere that name sidecars
    below the roots: give every place that uses them.

    Parameters
    ----------
    roots : sequence of str
        Layers, which stand for their whole folder, or folders.
    move : bool
        Move; else only say what would be moved.
    min_age_hours : float
        Younger files are spared.
    ignore : sequence of str
        Patterns of layers that may be missing or broken, because they name no sidecar.

    Returns
    -------
    Collection
        With problems, nothing was moved: a layer that cannot be read may name anything.

    Raises
    ------
    StageError
        A root does not exist.
    """
    folders = sorted(
        {os.path.realpath(root if os.path.isdir(root) else os.path.dirname(root) or ".") for root in roots}
    )
    for root in roots:
        if not os.path.exists(root):
            raise StageError(f"{root} does not exist; name a layer or a folder of layers")
    layers = {os.path.realpath(layer): None for folder in folders for layer in layers_below(folder)}
    uses = sidecar_uses(layers, ignore=ignore)
    problems = list(uses.problems)
    unnamed: list[Unnamed] = []
    partly: list[Unnamed] = []
    spared: dict[str, str] = {}
    files = _sidecars_below(folders)
    for file in files:
        if uses.names(file):
            unused = _unnamed_payloads(file, uses, problems)
            if unused:
                partly.append(Unnamed(file, os.path.getsize(file), unused))
        elif reason := _reason_to_spare(file, min_age_hours):
            spared[file] = reason
        else:
            unnamed.append(Unnamed(file, os.path.getsize(file), sidecar.list_payloads(file)))
    if move and not problems and not uses.is_current:
        problems.append("a layer changed while sidecars were looked for; run it again")
    if move and not problems:
        stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
        unnamed = [replace(item, moved_to=_to_trash(item.file, stamp)) for item in unnamed]
    return Collection(len(uses.layers), len(files), tuple(unnamed), tuple(partly), spared, tuple(problems))


def _sidecars_below(folders: Sequence[str]) -> list[str]:
    found: dict[str, None] = {}
    for top in folders:
        for folder, below, names in os.walk(top):
            below[:] = [name for name in below if name != TRASH]
            found.update({os.path.join(folder, name): None for name in names if name.endswith(SUFFIX)})
    return sorted(found)


def _unnamed_payloads(file: str, uses: SidecarUses, problems: list[str]) -> tuple[str, ...]:
    try:
        aliases = sidecar.list_aliases(file)
        kept = uses.digests | {new for old, new in aliases.items() if old in uses.digests}
        return tuple(digest for digest in sidecar.list_payloads(file) if digest not in kept)
    except SidecarError as problem:
        problems.append(str(problem))
        return ()


def _reason_to_spare(file: str, min_age_hours: float) -> str:
    if os.path.islink(file):
        return "it is a symbolic link"
    if (age := (clock.time() - os.stat(file).st_mtime) / 3600.0) < min_age_hours:
        return f"it is {max(age, 0.0):.1f} hours old"
    if os.path.exists(manifest_path(file)):
        return "it is published"
    try:
        sidecar.list_payloads(file)
        return "it is published" if sidecar.is_published(file) else ""
    except SidecarError as problem:
        return f"it cannot be read ({problem})"


def _to_trash(file: str, stamp: str) -> str:
    folder = os.path.join(os.path.dirname(file), TRASH, stamp)
    target = os.path.join(folder, os.path.basename(file))
    try:
        os.makedirs(folder, exist_ok=True)
        if os.path.exists(target):
            raise SidecarError(f"{target} exists; wait a second and run it again")
        os.rename(file, target)
    except OSError as problem:
        raise SidecarError(f"{file} cannot be moved to {folder} ({problem.strerror}); check permissions") from problem
    return target


# Manifests of published files -----------------------------------------------------------------------------------------


def manifest_path(file: str) -> str:
    """The manifest beside a published sidecar."""
    return file.removesuffix(SUFFIX) + MANIFEST_SUFFIX


def write_manifest(file: str, content: Mapping[str, object]) -> str:
    """Write the manifest of a published file, read-only. Raises `SidecarError` where it exists or cannot be written."""
    return str(write_text_beside(Path(file), MANIFEST_SUFFIX, json.dumps(content, indent=2) + "\n"))
