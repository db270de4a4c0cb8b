"""Cases of variants: grades of a stack, looks of an edit."""

from __future__ import annotations

from tests.composition.cases_of_layers import BLOCK, ROOM, dim, hue, shot, warm
from tests.composition.stages import Case, amount, edit, keys, layer, listing, over, stack, values


def variants(name: str, **bodies: str) -> str:
    """A variant set with what each variant says."""
    each = "\n".join(f'"{variant}" {{\n{body}\n}}' for variant, body in bodies.items())
    return f'variantSet "{name}" = {{\n{each}\n}}'


def selecting(name: str, variant: str, declare: bool = False) -> str:
    """Metadata that selects a variant."""
    return f'variants = {{ string {name} = "{variant}" }}' + (f'\nprepend variantSets = "{name}"' if declare else "")


GRADED = layer(
    stack(
        warm(),
        variants(
            "grade",
            dusk="\n".join([over("warm", values(color=(3, 1, 0.25)), amount({1: 1, 9: 0.5})), dim(), listing("dim")]),
            day="\n".join([over("warm", values(gain=1.5)), hue(), listing("hue", how="prepend")]),
        ),
        listed=["warm"],
        metadata=selecting("grade", "dusk", declare=True),
    ),
    weaker=["scene.usda"],
)

CASES = (
    Case(
        "the dusk grade of a stack",
        {"sequence.usda": GRADED, "shot.usda": shot(over("dim", values(gain=0.6)))},
        flat=stack(dim(gain=0.6), warm(amount({1: 1, 9: 0.5})), listed=["dim", "warm"]),
        winners={
            "warm.color": "sequence.usda",  # the opinion beside the variant, which is stronger than the one in it
            "warm.amount": "sequence.usda",
            "warm.amount.source": "timeSamples",
            "dim.gain": "shot.usda",
            "dim.listed": "sequence.usda",
        },
    ),
    Case(
        "the day grade of a stack, chosen by the shot",
        {"sequence.usda": GRADED, "shot.usda": shot(metadata=selecting("grade", "day"))},
        session=layer(stack(over("hue", values("hsv", hue=90)), over=True)),
        flat=stack(hue(hue=90), warm(gain=1.5), listed=["hue", "warm"]),
        winners={"hue.hue": "session.usda", "hue.listed": "sequence.usda", "warm.gain": "sequence.usda"},
    ),
    Case(
        "a grade that the shot adds and the session chooses",
        {
            "sequence.usda": GRADED,
            "shot.usda": shot(
                variants("grade", night="\n".join([over("warm", values(gain=0.25)), hue(), listing("hue")]))
            ),
        },
        session=layer(stack(over=True, metadata=selecting("grade", "night"))),
        flat=stack(hue(), warm(gain=0.25), listed=["hue", "warm"]),
        winners={"hue.listed": "shot.usda", "warm.gain": "shot.usda", "warm.listed": "sequence.usda"},
    ),
    Case(
        "a variant of one edit",
        {
            "sequence.usda": layer(
                stack(
                    edit(
                        "warm",
                        variants("look", soft=amount(0.25), hard=values(color=(4, 2, 1)) + "\n" + keys("half")),
                        receivers=[ROOM],
                        casters=[BLOCK],
                        metadata=selecting("look", "soft", declare=True),
                    ),
                    listed=["warm"],
                ),
                weaker=["scene.usda"],
            ),
            "shot.usda": shot(over("warm", metadata=selecting("look", "hard"))),
        },
        flat=stack(warm(keys("half"), color=(4, 2, 1)), listed=["warm"]),
        winners={"warm.color": "sequence.usda", "warm.keys": "sequence.usda", "warm.amount": ""},
    ),
)
