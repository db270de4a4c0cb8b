"""Cases of classes, references, payloads, relocates and instances."""

from __future__ import annotations

from tests.composition.cases_of_layers import (
    ALL,
    BLOCK,
    PILLAR,
    ROOM,
    WARM,
    dim,
    hue,
    shot,
    warm,
)
from tests.composition.stages import (
    SCENE,
    SIDECAR,
    STACK,
    Case,
    amount,
    edit,
    keys,
    layer,
    listing,
    over,
    select,
    stack,
    values,
)

#: A class above the default prim's edits that they all inherit.
LOOK = """class Scope "_look" ( prepend apiSchemas = ["IcheatEditAPI", "IcheatScaleAPI"] )
{
    color3f icheat:scale:color = (2, 1, 0.5)
    float icheat:amount = 0.5
    append rel collection:icheatCasters:includes = </World/Block>
}
"""


def library(*edits: str, body: str = "", metadata: str = "") -> str:
    """A layer of edits to reference, which knows no scene."""
    text = "\n".join((body, *edits))
    return f'#usda 1.0\n(\ndefaultPrim = "Library"\n)\ndef Scope "Library" ({metadata})\n{{\n{text}\n}}\n'


ROSY = values(color=(2, 0.8, 0.9))
GREY = edit("grey", values("hsv", saturation=0.25), operation="hsv")


def borrowed(name: str, *body: str, timing: str = "") -> str:
    """An edit of the library, by reference."""
    text = "\n".join(body)
    return f'def "{name}" (\nprepend references = @./library/edits.usda@</Library/{name}> {timing}\n)\n{{\n{text}\n}}'


INSTANCES = """
    def Xform "Chair"
    {
        def Cube "Seat"
        {
            double size = 0.5
            color3f[] primvars:displayColor = [(0.8, 0.6, 0.1)]
            double3 xformOp:translate = (0, -1.75, 0)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }
    }
    def Xform "Left" (
        instanceable = true
        prepend references = </World/Chair>
    )
    {
        double3 xformOp:translate = (-1, 0, 0.3)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Xform "Right" (
        instanceable = true
        prepend references = </World/Chair>
    )
    {
        double3 xformOp:translate = (1, 0, 0.3)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
"""
SEATS = ("/World/Chair/Seat", "/World/Left/Seat", "/World/Right/Seat")


def zone(name: str, travel: str, softness: float) -> str:
    """A sphere that edits are limited to, on its way."""
    return f"""def Sphere "{name}" (
    prepend apiSchemas = ["IcheatRegionAPI"]
)
{{
    uniform token purpose = "guide"
    double radius = 1.5
    float icheat:softness = {softness}
    double3 xformOp:translate.timeSamples = {{ {travel} }}
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}"""


CASES = (
    Case(
        "edits inherit a class that the shot overrides for all of them",
        {
            "sequence.usda": layer(
                LOOK
                + stack(
                    edit("warm", receivers=[ROOM], metadata="prepend inherits = </World/_look>"),
                    edit("other", amount(2), receivers=[PILLAR], metadata="prepend inherits = </World/_look>"),
                    listed=["warm", "other"],
                ),
                weaker=["scene.usda"],
            ),
            "shot.usda": layer(over("_look", values(color=(0.5, 1, 2))), weaker=["sequence.usda"]),
        },
        session=layer(over("_look", amount(0.75))),
        flat=stack(
            edit("warm", amount(0.75), color=(0.5, 1, 2), receivers=[ROOM], casters=[BLOCK]),
            edit("other", amount(2), color=(0.5, 1, 2), receivers=[PILLAR], casters=[BLOCK]),
            listed=["warm", "other"],
        ),
        winners={"warm.color": "shot.usda", "warm.amount": "session.usda", "other.amount": "sequence.usda"},
        retimings=("sublayer",),  # Below a reference the session's class would be stronger than what an edit says.
    ),
    Case(
        "a stack inherits its edits from a class that the shot adds to",
        {
            "sequence.usda": layer(
                'class Scope "_grade" (\nprepend apiSchemas = ["IcheatStackAPI"]\n)\n{\n'
                + "append rel icheat:edits = [</World/_grade/warm>, </World/_grade/dim>]\n"
                + warm(amount({1: 0, 9: 1}))
                + "\n"
                + dim()
                + '\n}\ndef Scope "Edits" (\nprepend inherits = </World/_grade>\n)\n{\n}',
                weaker=["scene.usda"],
            ),
            "shot.usda": layer(
                over("_grade", "append rel icheat:edits = </World/_grade/hue>", hue())
                + "\n"
                + stack(over("warm", values(gain=0.5)), listing("dim", how="delete"), over=True),
                weaker=["sequence.usda"],
            ),
        },
        flat=stack(warm(amount({1: 0, 9: 1}), gain=0.5), hue(), listed=["warm", "hue"]),
        winners={
            "warm.gain": "shot.usda",
            "warm.amount": "sequence.usda",
            "warm.listed": "sequence.usda",
            "hue.listed": "shot.usda",
        },
        removed={"dim": "shot.usda"},
    ),
    Case(
        "an edit specializes another and keeps what it says itself",
        {
            "sequence.usda": layer(
                stack(
                    warm(amount(0.5)),
                    edit(
                        "hot",
                        values(gain=2),
                        select("Receivers", PILLAR),
                        metadata=f"prepend specializes = <{STACK}/warm>",
                    ),
                    listed=["warm", "hot"],
                ),
                weaker=["scene.usda"],
            ),
            # What the shot says about the general edit is weaker than what the special one says anywhere.
            "shot.usda": shot(over("warm", values(gain=9), amount({1: 0, 9: 1}))),
        },
        flat=stack(
            warm(amount({1: 0, 9: 1}), gain=9),
            edit("hot", amount({1: 0, 9: 1}), **(WARM | {"gain": 2, "receivers": [ROOM, PILLAR]})),  # type: ignore[arg-type]
            listed=["warm", "hot"],
        ),
        winners={"hot.gain": "sequence.usda", "hot.amount": "shot.usda", "hot.color": "sequence.usda"},
    ),
    Case(
        "a library's edits, referenced by the sequence and aimed by the shot",
        {
            "library/edits.usda": library(edit("rosy", ROSY, amount({1: 0, 9: 1})), GREY),
            "sequence.usda": layer(
                stack(
                    borrowed("rosy", select("Casters", ROOM), timing="(offset = 2; scale = 0.5)"),
                    borrowed("grey", select("Casters", PILLAR)),
                    listed=["rosy", "grey"],
                ),
                weaker=["scene.usda"],
            ),
            "shot.usda": shot(
                over("rosy", select("Receivers", BLOCK, PILLAR)),
                over("grey", select("Receivers", ROOM), values("hsv", saturation=0.5)),
            ),
        },
        flat=stack(
            edit("rosy", ROSY, amount({2.5: 0, 6.5: 1}), receivers=[BLOCK, PILLAR], casters=[ROOM]),
            edit("grey", operation="hsv", saturation=0.5, receivers=[ROOM], casters=[PILLAR]),
            listed=["rosy", "grey"],
        ),
        winners={
            "rosy.color": "edits.usda",
            "rosy.amount": "edits.usda",
            "rosy.amount.source": "timeSamples",
            "grey.saturation": "shot.usda",
            "grey.operation": "edits.usda",
            "rosy.listed": "sequence.usda",
        },
    ),
    Case(
        "a library's edit with keys in a sidecar beside the library",
        {
            "library/edits.usda": library(
                edit("rosy", keys({1: "half", 9: "tint"}, f"@../{SIDECAR}@").replace("</World>", "</Library/Set>"))
            ),
            "sequence.usda": layer(
                stack(
                    borrowed("rosy", select("Casters", ROOM, BLOCK), "rel icheat:anchor = </World>"), listed=["rosy"]
                ),
                weaker=["scene.usda"],
            ),
            "shot.usda": shot(over("rosy", select("Receivers", ROOM, BLOCK))),
        },
        flat=stack(
            edit("rosy", keys({1: "half", 9: "tint"}), receivers=[ROOM, BLOCK], casters=[ROOM, BLOCK]), listed=["rosy"]
        ),
        winners={"rosy.keys": "edits.usda"},
    ),
    Case(
        "a whole stack by a payload arc, whose list of edits comes along",
        {
            "library/edits.usda": library(
                edit("rosy", ROSY, amount({1: 0, 9: 1})),
                GREY,
                body="append rel icheat:edits = [</Library/rosy>, </Library/grey>]",
                metadata='prepend apiSchemas = ["IcheatStackAPI"]',
            ),
            "sequence.usda": layer(
                'def "Edits" (\nprepend payload = @./library/edits.usda@ (scale = 0.5)\n)\n{\n'
                + over("rosy", select("Receivers", ROOM), select("Casters", ROOM))
                + "\n"
                + over("grey", select("Receivers", ROOM), select("Casters", ROOM))
                + "\n}",
                weaker=["scene.usda"],
            ),
            "shot.usda": shot(warm(), listed=["warm"]),
        },
        session=layer(stack(over=True, listed=["grey"], how="delete")),
        flat=stack(
            edit("rosy", ROSY, amount({0.5: 0, 4.5: 1}), receivers=[ROOM], casters=[ROOM]),
            warm(),
            listed=["rosy", "warm"],
        ),
        winners={"rosy.listed": "edits.usda", "warm.listed": "shot.usda"},
        removed={"grey": "session.usda"},
    ),
    Case(
        "a reference drops targets outside of what it brings",
        {
            "library/edits.usda": library(edit("rosy", ROSY, receivers=["/Stage/Set", "/Library/Set"])),
            "sequence.usda": layer(
                stack(borrowed("rosy", select("Casters", BLOCK)), listed=["rosy"]), weaker=["scene.usda"]
            ),
            "shot.usda": shot(over("rosy", select("Receivers", PILLAR))),
        },
        flat=stack(edit("rosy", ROSY, receivers=[PILLAR], casters=[BLOCK]), listed=["rosy"]),
        winners={"rosy.color": "edits.usda"},
        findings=("TargetDropped",),
    ),
    Case(
        "limits, lights and a target of a library follow the reference, the layers' times and the shot",
        {
            "library/edits.usda": library(
                zone("zone", "1: (-1, -2, 0), 9: (1, -2, 0)", 0.5),
                edit("rosy", ROSY, "rel icheat:receiverLimits = </Library/zone>"),
                edit("turned", operation="redirect", spread=20),
                body="append rel icheat:edits = [</Library/rosy>, </Library/turned>]",
                metadata='prepend apiSchemas = ["IcheatStackAPI"]',
            ),
            "sequence.usda": layer(
                'def "Edits" (\nprepend references = @./library/edits.usda@ (scale = 0.5)\n)\n{\n'
                + over("rosy", select("Receivers", ROOM), select("Casters", ROOM), "rel icheat:lights = </World/Lamp>")
                + "\n"
                + over(
                    "turned", select("Receivers", ROOM), select("Casters", ROOM), "rel icheat:target = </World/Block>"
                )
                + "\n}",
                weaker=["scene.usda"],
            ),
            "shot.usda": shot(
                over("zone", "float icheat:softness = 0.75"), over("turned", f"rel icheat:target = <{PILLAR}>")
            ),
        },
        flat=stack(
            zone("zone", "0.5: (-1, -2, 0), 4.5: (1, -2, 0)", 0.75),
            edit(
                "rosy",
                ROSY,
                f"rel icheat:receiverLimits = <{STACK}/zone>",
                "rel icheat:lights = </World/Lamp>",
                receivers=[ROOM],
                casters=[ROOM],
            ),
            edit(
                "turned",
                f"rel icheat:target = <{PILLAR}>",
                operation="redirect",
                spread=20,
                receivers=[ROOM],
                casters=[ROOM],
            ),
            listed=["rosy", "turned"],
        ),
        winners={"rosy.color": "edits.usda", "turned.spread": "edits.usda", "rosy.listed": "edits.usda"},
    ),
    Case(
        "a relocated edit is listed and overridden by its new path",
        {
            "library/edits.usda": library(edit("rosy", ROSY, amount(0.5))),
            "sequence.usda": layer(
                'def "Brought" (\nprepend references = @./library/edits.usda@\n)\n{\n}\n'
                + stack(
                    over("rosy", select("Receivers", ROOM), select("Casters", BLOCK), amount({1: 1, 9: 0.5})),
                    listed=["rosy"],
                ),
                weaker=["scene.usda"],
                metadata=f"relocates = {{ </World/Brought/rosy>: <{STACK}/rosy> }}",
            ),
            "shot.usda": shot(over("rosy", values(gain=1.5))),
        },
        flat=stack(
            edit("rosy", ROSY, amount({1: 1, 9: 0.5}), gain=1.5, receivers=[ROOM], casters=[BLOCK]), listed=["rosy"]
        ),
        winners={"rosy.color": "edits.usda", "rosy.amount": "sequence.usda", "rosy.gain": "shot.usda"},
    ),
    Case(
        "edits outside of instances select what lies in them",
        {
            "sequence.usda": layer(
                stack(
                    warm(receivers=["/World/Left"], casters=[ROOM]),
                    dim(receivers=[ROOM], casters=["/World/Right/Seat"]),
                    listed=ALL[:2],
                ),
                weaker=["scene.usda"],
            ),
            "shot.usda": shot(over("warm", select("Receivers", "/World/Right/Seat"))),
        },
        session=layer(stack(over("warm", f"append rel collection:icheatReceivers:excludes = <{SEATS[1]}>"), over=True)),
        flat=stack(
            warm(receivers=[SEATS[2]], casters=[ROOM]), dim(receivers=[ROOM], casters=[SEATS[2]]), listed=ALL[:2]
        ),
        scene=SCENE + INSTANCES,
        surfaces=(ROOM, BLOCK, PILLAR, *SEATS),
    ),
)
