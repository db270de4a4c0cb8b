"""Cases of one layer over another: sublayers, session, list edits, muting, blocks, key overrides."""

from __future__ import annotations

from tests.composition.stages import Case, amount, edit, keys, layer, listing, over, select, stack, values

ROOM, BLOCK, PILLAR = "/World/Room", "/World/Block", "/World/Pillar"

#: What most sequences hold, in this order.
WARM = {"color": (3, 1.5, 0.5), "receivers": [ROOM], "casters": [BLOCK]}
DIM = {"gain": 0.4, "receivers": [BLOCK], "casters": [ROOM]}
HUE = {"operation": "hsv", "hue": 120, "saturation": 0.5, "receivers": [ROOM, PILLAR], "casters": [BLOCK, PILLAR]}


def warm(*body: str, **changes: object) -> str:
    return edit("warm", *body, **(WARM | changes))  # type: ignore[arg-type]


def dim(*body: str, **changes: object) -> str:
    return edit("dim", *body, **(DIM | changes))  # type: ignore[arg-type]


def hue(*body: str, **changes: object) -> str:
    return edit("hue", *body, **(HUE | changes))  # type: ignore[arg-type]


ALL = ("warm", "dim", "hue")
SEQUENCE = layer(stack(warm(), dim(), hue(), listed=ALL), weaker=["scene.usda"])


def shot(*body: str, **more: object) -> str:
    """A shot layer over the sequence."""
    return layer(stack(*body, over=True, **more), weaker=["sequence.usda"])  # type: ignore[arg-type]


def keyed(*body: str, **changes: object) -> str:
    """An edit whose selection and amount are the same in all cases of keys."""
    return edit("keyed", *body, **({"receivers": [ROOM, BLOCK], "casters": [ROOM, BLOCK]} | changes))  # type: ignore[arg-type]


KEYED_SEQUENCE = layer(
    stack(keyed(keys({1: "half", 11: "double"})), dim(), listed=("keyed", "dim")), weaker=["scene.usda"]
)

CASES = (
    Case(
        "a shot overrides one parameter, the session another",
        {"sequence.usda": SEQUENCE, "shot.usda": shot(over("warm", values(color=(0.5, 1.5, 3))))},
        session=layer(stack(over("hue", values("hsv", hue=-60)), over=True)),
        flat=stack(warm(color=(0.5, 1.5, 3)), dim(), hue(hue=-60), listed=ALL),
        winners={
            "warm.color": "shot.usda",
            "warm.gain": "",
            "warm.gain.source": "fallback",
            "warm.color.source": "default",
            "hue.hue": "session.usda",
            "hue.saturation": "sequence.usda",
            "dim.gain": "sequence.usda",
            "warm.listed": "sequence.usda",
        },
    ),
    Case(
        "a shot mutes an edit and the session unmutes another",
        {
            "sequence.usda": layer(
                stack(warm(), dim("uniform bool icheat:enabled = false"), hue(), listed=ALL), weaker=["scene.usda"]
            ),
            "shot.usda": shot(over("warm", "uniform bool icheat:enabled = false")),
        },
        session=layer(stack(over("dim", "uniform bool icheat:enabled = true"), over=True)),
        flat=stack(warm("uniform bool icheat:enabled = false"), dim(), hue(), listed=ALL),
        winners={"warm.enabled": "shot.usda", "dim.enabled": "session.usda", "hue.enabled": ""},
    ),
    Case(
        "a shot adds an edit after those of the sequence, and the session before them",
        {
            "sequence.usda": layer(stack(warm(), dim(), listed=ALL[:2]), weaker=["scene.usda"]),
            "shot.usda": shot(hue(), listed=["hue"]),
        },
        session=layer(
            stack(edit("first", amount(0.5), gain=3, receivers=[ROOM], casters=[ROOM]), listed=["first"], how="prepend")
        ),
        flat=stack(
            edit("first", amount(0.5), gain=3, receivers=[ROOM], casters=[ROOM]),
            warm(),
            dim(),
            hue(),
            listed=["first", *ALL],
        ),
        winners={"hue.listed": "shot.usda", "first.listed": "session.usda", "warm.listed": "sequence.usda"},
    ),
    Case(
        "a shot reorders by appending again",
        {"sequence.usda": SEQUENCE, "shot.usda": shot(listed=["warm"])},
        flat=stack(dim(), hue(), warm(), listed=["dim", "hue", "warm"]),
        winners={"warm.listed": "shot.usda", "dim.listed": "sequence.usda"},
    ),
    Case(
        "a shot reorders by a reorder statement",
        {"sequence.usda": SEQUENCE, "shot.usda": shot(listed=["hue", "dim", "warm"], how="reorder")},
        flat=stack(hue(), dim(), warm(), listed=["hue", "dim", "warm"]),
        winners={f"{name}.listed": "sequence.usda" for name in ALL},
    ),
    Case(
        "a shot takes an edit out and the session brings another back",
        {
            "sequence.usda": SEQUENCE,
            "shot.usda": shot(listing("dim", "hue", how="delete")),
        },
        session=layer(stack(over=True, listed=["hue"])),
        flat=stack(warm(), hue(), listed=["warm", "hue"]),
        winners={"hue.listed": "session.usda", "warm.listed": "sequence.usda"},
        removed={"dim": "shot.usda"},
    ),
    Case(
        "a shot lists explicitly",
        {"sequence.usda": SEQUENCE, "shot.usda": shot(listed=["hue", "warm"], how="")},
        flat=stack(hue(), warm(), listed=["hue", "warm"]),
        winners={"hue.listed": "shot.usda", "warm.color": "sequence.usda"},
        removed={"dim": "shot.usda"},
    ),
    Case(
        "a shot deactivates an edit",
        {"sequence.usda": SEQUENCE, "shot.usda": shot(over("dim", metadata="active = false"))},
        flat=stack(warm(), hue(), listed=["warm", "hue"]),
    ),
    Case(
        "a shot turns the stack off",
        {"sequence.usda": SEQUENCE, "shot.usda": shot("uniform bool icheat:stackEnabled = false")},
        flat=stack("uniform bool icheat:stackEnabled = false", warm(), dim(), hue(), listed=ALL),
    ),
    Case(
        "a muted shot layer gives the sequence back",
        {
            "sequence.usda": SEQUENCE,
            "middle.usda": layer(
                stack(over("warm", values(gain=9)), listing("dim", how="delete"), over=True), weaker=["sequence.usda"]
            ),
            "shot.usda": layer(stack(over("hue", amount(0.5)), over=True), weaker=["middle.usda", "sequence.usda"]),
        },
        muted=("middle.usda",),
        flat=stack(warm(), dim(), hue(amount(0.5)), listed=ALL),
        winners={"warm.gain": "", "hue.amount": "shot.usda"},
    ),
    Case(
        "a shot changes what an edit selects",
        {
            "sequence.usda": SEQUENCE,
            "shot.usda": shot(
                over("warm", select("Receivers", PILLAR)),
                over("dim", select("Casters", ROOM, how="delete"), select("Casters", BLOCK)),
            ),
        },
        session=layer(stack(over("hue", f"append rel collection:icheatReceivers:excludes = <{ROOM}>"), over=True)),
        flat=stack(warm(receivers=[ROOM, PILLAR]), dim(casters=[BLOCK]), hue(receivers=[PILLAR]), listed=ALL),
    ),
    Case(
        "a shot changes the operation and keeps the amount",
        {
            "sequence.usda": layer(stack(warm(amount(0.5)), listed=["warm"]), weaker=["scene.usda"]),
            "shot.usda": shot(
                over(
                    "warm",
                    'uniform token icheat:operation = "hsv"',
                    values("hsv", saturation=0),
                    metadata='prepend apiSchemas = ["IcheatHsvAPI"]',
                )
            ),
        },
        flat=stack(
            edit("warm", amount(0.5), operation="hsv", saturation=0, receivers=[ROOM], casters=[BLOCK]),
            listed=["warm"],
        ),
        winners={"warm.operation": "shot.usda", "warm.amount": "sequence.usda", "warm.saturation": "shot.usda"},
    ),
    Case(
        "a shot overrides one key",
        {
            "sequence.usda": KEYED_SEQUENCE,
            "shot.usda": shot(over("keyed", keys({1: "half", 11: "tint"}))),
        },
        session=layer(stack(over("keyed", amount(0.75)), over=True)),
        flat=stack(keyed(amount(0.75), keys({1: "half", 11: "tint"})), dim(), listed=("keyed", "dim")),
        winners={"keyed.keys": "shot.usda", "keyed.amount": "session.usda", "keyed.listed": "sequence.usda"},
    ),
    Case(
        "a shot overrides one payload",
        {
            "sequence.usda": layer(stack(keyed(keys("half")), listed=["keyed"]), weaker=["scene.usda"]),
            "shot.usda": shot(over("keyed", keys("tint"))),
        },
        flat=stack(keyed(keys("tint")), listed=["keyed"]),
        winners={"keyed.keys": "shot.usda"},
    ),
    Case(
        "a shot overrides a parameter of the payload's recipe",
        {"sequence.usda": KEYED_SEQUENCE, "shot.usda": shot(over("keyed", values(gain=1.25)))},
        flat=stack(keyed(keys({1: "half", 11: "double"}), gain=1.25), dim(), listed=("keyed", "dim")),
        winners={"keyed.keys": "sequence.usda", "keyed.gain": "shot.usda"},
    ),
    Case(
        "a shot blocks a parameter and an amount",
        {
            "sequence.usda": layer(
                stack(warm(amount(0.25)), dim(amount({1: 0, 9: 1})), listed=ALL[:2]), weaker=["scene.usda"]
            ),
            "shot.usda": shot(
                over("warm", "color3f icheat:scale:color = None", values(gain=2)), over("dim", amount("None"))
            ),
        },
        session=layer(stack(over("warm", amount("None")), over=True)),
        flat=stack(warm(color=(1, 1, 1), gain=2), dim(), listed=ALL[:2]),
        winners={
            "warm.color": "shot.usda",
            "warm.color.source": "block",
            "warm.amount": "session.usda",
            "dim.amount": "shot.usda",
            "dim.amount.source": "block",
        },
    ),
    Case(
        "a block among time samples gives the fallback from there on",
        {
            "sequence.usda": layer(
                stack(
                    warm(amount({1: 0.25, 3: "None", 9: 0.5}), color={1: (2, 2, 2), 3: "None"}),
                    dim(gain={1: 0.25, 9: "None"}),
                    listed=ALL[:2],
                ),
                weaker=["scene.usda"],
            ),
            "shot.usda": shot(over("dim", amount(0.5))),
        },
        flat=stack(warm(color=(1, 1, 1)), dim(amount(0.5), gain=0.25), listed=ALL[:2]),
        winners={
            "warm.amount": "sequence.usda",
            "warm.amount.source": "timeSamples",
            "dim.gain": "sequence.usda",
            "dim.amount": "shot.usda",
        },
    ),
    Case(
        "a shot blocks a payload, which leaves an edit that does nothing",
        {
            "sequence.usda": KEYED_SEQUENCE,
            "shot.usda": shot(over("keyed", "asset icheat:filePath = None", "token icheat:payload = None")),
        },
        flat=stack(dim(), keyed("token icheat:payload.timeSamples = { 1: None }"), listed=("keyed", "dim")),
        winners={"keyed.keys": "shot.usda"},
    ),
    Case(
        "a shot blocks one key",
        {"sequence.usda": KEYED_SEQUENCE, "shot.usda": shot(over("keyed", keys({1: None, 11: "double"})))},
        flat=stack(keyed(keys({1: None, 11: "double"})), dim(), listed=("keyed", "dim")),
        winners={"keyed.keys": "shot.usda"},
    ),
    Case(
        "a shot changes how keys follow each other",
        {
            "sequence.usda": KEYED_SEQUENCE,
            "shot.usda": shot(over("keyed", 'uniform token icheat:keyInterpolation = "held"')),
        },
        flat=stack(keyed(keys("half")), dim(), listed=("keyed", "dim")),
        winners={"keyed.keys": "sequence.usda"},
    ),
)
