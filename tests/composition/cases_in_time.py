"""Cases of values in time: layer offsets, splines, and files named by expression variables."""

from __future__ import annotations

from tests.composition.cases_of_layers import HUE, hue, keyed, shot, warm
from tests.composition.stages import Case, amount, edit, keys, layer, over, stack, values

#: An amount that a cubic with flat ends eases from 0 at 1 to 1 at 9: 3 x^2 - 2 x^3 at x = (time - 1) / 8.
SPLINE = """float icheat:amount.spline = {
    bezier,
    1: 0; post curve (2.6666666667, 0),
    9: 1; pre (2.6666666667, 0),
}"""

CASES = (
    Case(
        "an expression variable of the shot names its own sidecar",
        {
            "sequence.usda": layer(
                stack(keyed(keys({1: "half", 11: "tint"}, '@`"./${SHOT}.v001.icheat.h5"`@')), listed=["keyed"]),
                weaker=["scene.usda"],
            ),
            "shot.usda": layer(
                "", weaker=["sequence.usda"], metadata='expressionVariables = { string SHOT = "edits" }'
            ),
        },
        flat=stack(keyed(keys({1: "half", 11: "tint"})), listed=["keyed"]),
        winners={"keyed.keys": "sequence.usda"},
        retimings=("reference",),  # The variables are those of the root layer of a stage or of what is referenced.
    ),
    Case(
        "a sequence under a scaled offset, with keys and values in time",
        {
            "sequence.usda": layer(
                stack(
                    keyed(keys({1: "half", 11: "double"}), amount({1: 0.5, 11: 1})),
                    warm(color={1: (1, 1, 1), 11: (3, 1, 0.5)}),
                    hue(hue={1: 0, 11: 180}),
                    listed=["keyed", "warm", "hue"],
                ),
                weaker=["scene.usda"],
            ),
            "shot.usda": layer(
                stack(over("hue", values("hsv", saturation={0: 0, 10: 1})), over=True),  # not moved
                weaker=["@./sequence.usda@ (offset = -1; scale = 0.5)"],
            ),
        },
        flat=stack(
            keyed(keys({-0.5: "half", 4.5: "double"}), amount({-0.5: 0.5, 4.5: 1})),
            warm(color={-0.5: (1, 1, 1), 4.5: (3, 1, 0.5)}),
            hue(hue={-0.5: 0, 4.5: 180}, saturation={0: 0, 10: 1}),
            listed=["keyed", "warm", "hue"],
        ),
        winners={
            "keyed.amount.source": "timeSamples",
            "keyed.keys": "sequence.usda",
            "hue.saturation": "shot.usda",
            "hue.hue": "sequence.usda",
            "warm.color.source": "timeSamples",
        },
    ),
    Case(
        "a sequence at another rate of time codes than the shot",
        {
            "sequence.usda": layer(
                stack(keyed(keys({2: "half", 22: "double"}), amount({2: 0.5, 22: 1})), listed=["keyed"]),
                weaker=["scene.usda"],
                metadata="timeCodesPerSecond = 48",
            ),
            "shot.usda": shot(over("keyed", values(gain={1: 0.5, 11: 1.5}))),
        },
        flat=stack(
            keyed(keys({1: "half", 11: "double"}), amount({1: 0.5, 11: 1}), gain={1: 0.5, 11: 1.5}), listed=["keyed"]
        ),
        winners={"keyed.keys": "sequence.usda", "keyed.amount": "sequence.usda", "keyed.gain": "shot.usda"},
    ),
    Case(
        "splines ease an amount and a parameter",
        {
            "sequence.usda": layer(
                stack(
                    warm(SPLINE),
                    edit("hue", SPLINE.replace("amount", "hsv:hue"), **(HUE | {"hue": 7})),
                    listed=["warm", "hue"],
                ),  # type: ignore[arg-type]
                weaker=["scene.usda"],
            ),
            "shot.usda": shot(over("hue", amount(0.5))),
        },
        flat=stack(warm(amount(0.31640625)), hue(amount(0.5), hue=0.31640625), listed=["warm", "hue"]),
        winners={
            "warm.amount": "sequence.usda",
            "warm.amount.source": "spline",
            "hue.hue": "sequence.usda",
            "hue.hue.source": "spline",
            "hue.amount": "shot.usda",
        },
    ),
)
