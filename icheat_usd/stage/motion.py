"""Whether anything on a stage can change between two times."""

from __future__ import annotations

from pxr import Gf, Usd


def may_change(stage: Usd.Stage, begin: float, end: float) -> bool:
    """Whether some attribute may have different values at two times of [begin, end].

    False is certain; True only says that there are several time samples (or a
    spline), whose values may be equal.
    """
    prims = Usd.PrimRange(stage.GetPseudoRoot(), Usd.PrimAllPrimsPredicate)
    roots = [prims, *(Usd.PrimRange(prototype) for prototype in stage.GetPrototypes())]
    return any(
        attribute.ValueMightBeTimeVarying() and _varies(attribute, begin, end)
        for root in roots
        for prim in root
        for attribute in prim.GetAuthoredAttributes()
    )


def _varies(attribute: Usd.Attribute, begin: float, end: float) -> bool:
    for time in (begin, end):
        lower, upper = attribute.GetBracketingTimeSamples(time) or (time, time)
        if lower != upper:
            return True
    # Neither end lies between two samples: on one, before the first or behind the last; or there is a spline.
    return attribute.GetNumTimeSamples() < 2 or len(attribute.GetTimeSamplesInInterval(Gf.Interval(begin, end))) > 1
