"""The stacks on a stage, the one to use, and the edits that a stack lists."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from pxr import Sdf, Usd

from icheat_usd.errors import EditError
from icheat_usd.scene import Finding
from icheat_usd.stage import schema
from icheat_usd.stage.refusals import named_refusals


class Severity(StrEnum):
    """How bad a finding is."""

    ERROR = "error"
    WARNING = "warning"


@dataclass(frozen=True)
class EditFinding(Finding):
    """Something about an edit or a stack that its author should know."""

    severity: Severity = Severity.WARNING
    rule: str = ""  #: class in `icheat_usd.stage.check` that found it, "" where reading did


def stack_prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """Every active stack on the stage, in order of traversal, those in instances by their proxies."""
    everything = Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
    return [prim for prim in everything if schema.has_schema(prim, schema.STACK_API)]


@named_refusals
def find_stack(stage: Usd.Stage, stack: str | None = None, camera: str | None = None) -> str | None:
    """Path of the stack to use: the named one, else that of the render settings, else the camera's only one.

    Parameters
    ----------
    stack
        Path of the stack, absolute or relative to the default prim; or the name of a stack, if only one has it.
    camera
        Path of the camera that is rendered; anything that is no path counts as no camera. A stack that names no
        camera is for any camera, after those that do.

    Returns
    -------
    str or None
        None if the stage has no stack at all.

    Raises
    ------
    EditError
        The named stack does not exist, or several could be meant.
    """
    if stack is not None:
        return _named_stack(stage, stack)
    settings = stage.GetMetadata("renderSettingsPrimPath")
    if settings and schema.has_schema(stage.GetPrimAtPath(settings), schema.STACK_API):
        return str(settings)
    cameras_of = {str(prim.GetPath()): targets(prim, schema.CAMERA) for prim in stack_prims(stage)}
    if not cameras_of:
        return None
    if camera is not None and not camera.startswith("/"):
        camera = None
    candidates = [path for path, cameras in cameras_of.items() if camera is not None and camera in cameras]
    candidates = candidates or [path for path, cameras in cameras_of.items() if camera is None or not cameras]
    if len(candidates) == 1:
        return candidates[0]
    if camera is not None and not stage.GetPrimAtPath(camera):
        raise EditError(f"{camera} is named as camera but does not exist in {stage.GetRootLayer().identifier}")
    whose = f" for camera {camera}" if camera is not None else ""
    raise EditError(
        f"{stage.GetRootLayer().identifier}: {len(candidates) or 'none'} of the stacks {', '.join(cameras_of)} can be "
        f"meant{whose}; name one with --stack"
    )


def _named_stack(stage: Usd.Stage, stack: str) -> str:
    if Sdf.Path.IsValidPathString(stack):
        default = stage.GetDefaultPrim()
        path = Sdf.Path(stack).MakeAbsolutePath(default.GetPath() if default else Sdf.Path.absoluteRootPath)
        if schema.has_schema(stage.GetPrimAtPath(path), schema.STACK_API):
            return str(path)
    paths = [str(prim.GetPath()) for prim in stack_prims(stage)]
    found = [path for path in paths if path.rpartition("/")[2] == stack]
    if len(found) > 1:
        raise EditError(f"{stage.GetRootLayer().identifier}: '{stack}' may be {', '.join(found)}; name it by its path")
    if not found:
        known = f"it has {', '.join(paths)}" if paths else "make one with `icheat stack create`"
        raise EditError(f"{stage.GetRootLayer().identifier}: no stack '{stack}'; {known}")
    return found[0]


def targets(prim: Usd.Prim, relationship: str) -> tuple[str, ...]:
    """Composed targets of a relationship; empty where there is none."""
    rel = prim.GetRelationship(relationship)
    return tuple(str(path) for path in rel.GetTargets()) if rel else ()


def stack_prim(stage: Usd.Stage, path: str) -> Usd.Prim:
    """The prim of a stack.

    Raises
    ------
    EditError
        There is no stack at `path`.
    """
    prim = stage.GetPrimAtPath(path)
    if not schema.has_schema(prim, schema.STACK_API):
        known = ", ".join(str(p.GetPath()) for p in stack_prims(stage)) or "none"
        raise EditError(f"{stage.GetRootLayer().identifier}: {path} is no stack; the stage's stacks: {known}")
    return prim


def edit_prim(stage: Usd.Stage, path: str) -> Usd.Prim:
    """The prim of an edit.

    Raises
    ------
    EditError
        There is no edit at `path`.
    """
    prim = stage.GetPrimAtPath(path)
    if not schema.has_schema(prim, schema.EDIT_API):
        listed = [target for stack in stack_prims(stage) for target in targets(stack, schema.EDITS)]
        raise EditError(
            f"{stage.GetRootLayer().identifier}: {path} is no edit; the stage's edits: {', '.join(listed) or 'none'}"
        )
    return prim


def listed_edits(stack: Usd.Prim) -> tuple[list[Usd.Prim], list[EditFinding]]:
    """The edits that a stack applies, weakest first, and what is wrong with its other targets."""
    prims, findings, seen = [], [], set()
    path = str(stack.GetPath())
    for target in targets(stack, schema.EDITS):
        prim = stack.GetStage().GetPrimAtPath(target)
        if not prim:
            findings.append(EditFinding(path, schema.EDITS, f"{target} does not exist; remove it from the stack"))
        elif not prim.IsActive() or target in seen:
            continue
        elif not schema.has_schema(prim, schema.EDIT_API):
            message = f"{target} has no {schema.EDIT_API}; apply it or remove the target from the stack"
            findings.append(EditFinding(path, schema.EDITS, message))
        else:
            prims.append(prim)
        seen.add(target)
    return prims, findings
