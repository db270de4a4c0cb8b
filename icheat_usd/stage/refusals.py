"""What USD refuses while a stage is read, as one sentence."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Concatenate, ParamSpec, TypeVar

from pxr import Tf, Usd

from icheat_usd.errors import StageError

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
            return function(stage, *args, **kwargs)
        except Tf.ErrorException as error:
            said = str(getattr(error.args[0], "commentary", error.args[0])) if error.args else ""
            reason = " ".join(said.split())[:300] or "without a reason"
            raise StageError(
                f"{stage.GetRootLayer().identifier}: USD refuses what a layer says ({reason}); correct it there"
            ) from error

    return reading
