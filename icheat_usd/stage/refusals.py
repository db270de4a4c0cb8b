"""What USD refuses while a stage is read, as one sentence."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Concatenate, ParamSpec, TypeVar

from pxr import Sdf, Tf, Usd

from icheat_usd.errors import StageError
from icheat_usd.stage.opening import quiet_usd

P = ParamSpec("P")
R = TypeVar("R")


def named_refusals(
    function: Callable[Concatenate[Usd.Stage, P], R],
) -> Callable[Concatenate[Usd.Stage, P], R]:
    """Make a function of a stage raise `StageError` where USD itself refuses a value or a spec.

    Layers may hold values of other types than their schemas declare, and
    relationships where attributes are expected. USD then raises errors of its
    own from whatever is asked of the prim.
    """

    @functools.wraps(function)
    def reading(stage: Usd.Stage, *args: P.args, **kwargs: P.kwargs) -> R:
        try:
            with quiet_usd():
                return function(stage, *args, **kwargs)
        except Tf.ErrorException as error:
            said = str(getattr(error.args[0], "commentary", error.args[0])) if error.args else ""
            reason = " ".join(said.split())[:300] or "without a reason"
            raise StageError(
                f"{stage.GetRootLayer().identifier}: USD refuses what a layer says ({reason}); correct it there"
            ) from error
        except (TypeError, ValueError) as error:
            # A mistake of ours, unless a layer holds a value of another type than its attribute has.
            if (mistyped := _mistyped(stage)) is None:
                raise
            raise StageError(mistyped) from error

    return reading


def _mistyped(stage: Usd.Stage) -> str | None:
    """The first opinion whose type is not that of its attribute."""
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies(Usd.PrimAllPrimsPredicate)):
        for attribute in prim.GetAuthoredAttributes():
            declared = attribute.GetTypeName()
            for spec in attribute.GetPropertyStack():
                if not isinstance(spec, Sdf.AttributeSpec):
                    return f"{attribute.GetPath()} is a relationship in {spec.layer.identifier}; make it {declared}"
                if spec.typeName.type != declared.type:
                    return (
                        f"{attribute.GetPath()} is authored as {spec.typeName} in {spec.layer.identifier}, but it is "
                        f"{declared}; correct it there"
                    )
    return None
