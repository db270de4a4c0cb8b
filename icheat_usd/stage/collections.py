"""Which surfaces a collection of an edit includes."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from pxr import Sdf, Tf, Usd

from icheat_usd.edits.model import Selection
from icheat_usd.errors import EditError


def collection(edit: Usd.Prim, name: str) -> Usd.CollectionAPI:
    """The collection of an edit, usable for queries whether or not the schemas are registered.

    Where they are not, `includeRoot` has no value unless authored; USD takes that for false, which is our fallback.
    """
    return Usd.CollectionAPI(edit, name)


def select(edit: Usd.Prim, name: str, surface_paths: Iterable[str]) -> Selection:
    """The surfaces among `surface_paths` (scene paths) that the collection includes.

    A prim that is included takes its descendants along, instance proxies too, unless the collection's expansion
    rule says otherwise. Membership expressions are matched by USD, which knows only paths that the stage has.

    Raises
    ------
    EditError
        The membership expression asks for what this USD does not know.
    """
    try:
        query = collection(edit, name).ComputeMembershipQuery()
    except Tf.ErrorException as error:
        reason = str(error).partition(" : ")[2].partition("\n")[0].strip().strip("'")
        raise EditError(f"{edit.GetPath()}: the membership expression of {name} cannot be used ({reason})") from error
    return Selection(frozenset(path for path in set(surface_paths) if query.IsPathIncluded(Sdf.Path(path))))


def authored(edit: Usd.Prim, name: str) -> tuple[tuple[str, ...], tuple[str, ...], str]:
    """Includes, excludes and membership expression ("" where none) of a collection, as composed."""
    api = collection(edit, name)
    includes, excludes = (
        tuple(str(path) for path in rel.GetTargets()) if rel else ()
        for rel in (api.GetIncludesRel(), api.GetExcludesRel())
    )
    attribute = api.GetMembershipExpressionAttr()
    expression = attribute.Get() if attribute else None
    return includes, excludes, str(expression.GetText()) if expression else ""


def find_prims(stage: Usd.Stage, names: Iterable[str], what: str) -> tuple[Sdf.Path, ...]:
    """Paths of prims or collections that a person named: absolute, or relative to the default prim.

    Raises
    ------
    EditError
        A name matches nothing on the stage; the message suggests close paths.
    """
    return tuple(_find(stage, name, what) for name in names)


def surfaces_below(
    stage: Usd.Stage, includes: Iterable[str], excludes: Iterable[str], surface_paths: Iterable[str]
) -> list[str]:
    """Those of the surfaces that lie in or below an included prim or collection and not in or below an excluded one.

    Names are as `find_prims` takes them.
    """
    paths = list(surface_paths)

    def members(names: Iterable[str]) -> set[str]:
        found: set[str] = set()
        for path in find_prims(stage, names, "selection"):
            if path.IsPrimPath() or path == Sdf.Path.absoluteRootPath:
                top = str(path).rstrip("/")
                found |= {p for p in paths if p == top or p.startswith(top + "/")}
            else:
                prim, name = stage.GetPrimAtPath(path.GetPrimPath()), path.name.partition(":")[2]
                found |= select(prim, name, paths).paths
        return found

    wanted = members(includes) - members(excludes)
    return [path for path in paths if path in wanted]


def surfaces_matching(stage: Usd.Stage, expression: str, surface_paths: Iterable[str]) -> list[str]:
    """Those of the surfaces that a membership expression selects; relative patterns are below the default prim.

    Raises
    ------
    EditError
        The expression is ill-formed or asks for what this USD does not know.
    """
    paths = list(surface_paths)
    # USD matches expressions for collections alone, so one is made where no one sees it: on a stage of the same
    # layers, with a session layer of its own.
    session = Sdf.Layer.CreateAnonymous()
    if stage.GetSessionLayer():
        session.subLayerPaths.append(stage.GetSessionLayer().identifier)
    same = Usd.Stage.Open(stage.GetRootLayer(), session, stage.GetPathResolverContext(), Usd.Stage.LoadNone)
    same.MuteAndUnmuteLayers(stage.GetMutedLayers(), [])
    same.SetLoadRules(stage.GetLoadRules())
    same.SetEditTarget(session)
    holder = same.OverridePrim("/icheatSelection")
    chosen = Usd.CollectionAPI.Apply(holder, "chosen")
    chosen.CreateIncludeRootAttr().Set(False)
    chosen.CreateMembershipExpressionAttr().Set(parse_expression(stage, expression, "selection"))
    wanted = select(holder, "chosen", paths).paths
    return [path for path in paths if path in wanted]


def parse_expression(stage: Usd.Stage, text: str, where: str) -> Sdf.PathExpression:
    """A membership expression with absolute patterns; relative ones are below the default prim.

    Raises
    ------
    EditError
        It is ill-formed.
    """
    default = stage.GetDefaultPrim()
    try:
        expression = Sdf.PathExpression(text)
    except Tf.ErrorException as error:
        reason = str(error).partition(" : ")[2].strip().strip("'") or "unknown reason"
        raise EditError(f"{where}: '{text}' is no membership expression ({reason})") from error
    return expression.MakeAbsolute(default.GetPath() if default else Sdf.Path.absoluteRootPath)


def _find(stage: Usd.Stage, name: str, what: str) -> Sdf.Path:
    if not Sdf.Path.IsValidPathString(name):
        raise EditError(f"{what}: '{name}' is not a prim path; give one such as /World/Room/floor")
    path = Sdf.Path(name)
    default = stage.GetDefaultPrim()
    if not path.IsAbsolutePath():
        path = path.MakeAbsolutePath(default.GetPath() if default else Sdf.Path.absoluteRootPath)
    if path == Sdf.Path.absoluteRootPath:
        return path
    if stage.GetPrimAtPath(path.GetPrimPath()) and (path.IsPrimPath() or Usd.CollectionAPI.Get(stage, path)):
        return path
    raise EditError(f"{what}: the stage {stage.GetRootLayer().identifier} has no prim {path}{_hint(stage, path)}")


def _hint(stage: Usd.Stage, path: Sdf.Path) -> str:
    """What may be meant: prims of the same name elsewhere, siblings of a similar name, or just the siblings."""
    known = [str(prim.GetPath()) for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())]
    close = [p for p in known if p.rpartition("/")[2] == path.name][:3]
    first_missing = next(prefix for prefix in (*path.GetPrefixes(), path) if not stage.GetPrimAtPath(prefix))
    parent = stage.GetPrimAtPath(first_missing.GetParentPath())
    children = parent.GetFilteredChildrenNames(Usd.TraverseInstanceProxies())
    near = difflib.get_close_matches(first_missing.name, children, n=3)
    close = close or [str(parent.GetPath().AppendChild(name)) for name in near]
    if close:
        return f"; did you mean {' or '.join(close)}?"
    listed = ", ".join(children[:12]) + (", …" if len(children) > 12 else "")
    return f"; {parent.GetPath()} has {listed or 'nothing below it'}"
