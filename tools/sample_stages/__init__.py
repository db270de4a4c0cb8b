"""The sample stages, one module each, and what they are made of."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

from pxr import Sdf

from icheat_usd.sidecar import list_payloads

from . import animated_room, cornell_box, furnished_room, glossy_set, images, staircase
from .build import write_over_layer
from .edits import author_edits
from .operations import FOLDER as OPERATIONS
from .operations import SHOWN, build_operations

STAGES: dict[str, ModuleType] = {
    module.NAME: module for module in (cornell_box, furnished_room, glossy_set, staircase, animated_room)
}


#: Folders that `build_stage` can write.
NAMES = (*STAGES, OPERATIONS)


def build_stage(name: str, folder: Path) -> None:
    """Write one sample stage: scene.usda, textures, sequence.usda and shot.usda with their edits.

    The folder of operations has a layer for each, over the scenes beside it; those that are missing are made.
    """
    if name == OPERATIONS:
        for scene in {shown.scene for shown in SHOWN}:
            if not (folder.parent / scene / "scene.usda").exists():
                STAGES[scene].build(folder.parent / scene)
        build_operations(folder)
        return
    module = STAGES[name]
    module.build(folder)
    # Sidecars are write-once: without this a second run would make version 2 of them.
    for old in folder.glob("*.icheat.h5"):
        old.unlink()
    write_over_layer(folder / "sequence.usda", "scene.usda", module.SEQUENCE_DOC, module.FRAMES)
    author_edits(folder / "sequence.usda", module.SEQUENCE, make_stack=True)
    write_over_layer(folder / "shot.usda", "sequence.usda", module.SHOT_DOC, module.FRAMES)
    author_edits(folder / "shot.usda", module.SHOT, make_stack=False)


def differences(committed: Path, rebuilt: Path) -> list[str]:
    """One line for each file that is missing, superfluous or says something else; encodings do not count."""
    old = {path.relative_to(committed) for path in committed.rglob("*") if path.is_file()}
    new = {path.relative_to(rebuilt) for path in rebuilt.rglob("*") if path.is_file()}
    found = [f"{committed / path}: not committed" for path in sorted(new - old)]
    found += [f"{committed / path}: nothing makes this file" for path in sorted(old - new)]
    for path in sorted(old & new):
        if _content(committed / path) != _content(rebuilt / path):
            found.append(f"{committed / path}: differs from what tools/make_sample_stages writes")
    return found


def _content(path: Path) -> object:
    if path.suffix == ".usda":
        return Sdf.Layer.OpenAsAnonymous(str(path)).ExportToString()
    if path.suffix == ".png":
        return images.png_content(path.read_bytes())
    if path.suffix == ".h5":
        return list_payloads(path)  # their names say their content
    return path.read_bytes()
