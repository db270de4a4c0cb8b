"""What is wrong with the edits on a stage: one class per rule, in files by theme.

Rules ask the composed stage and the specs behind it; none needs the schemas
to be registered, and none stops at the first finding.
"""

from __future__ import annotations

from pxr import Usd

from icheat_usd.stage.check import baked, edits, keys, schemas, selections, stacks
from icheat_usd.stage.check.rule import Context, Rule, look_at
from icheat_usd.stage.edit_stack import PayloadReader
from icheat_usd.stage.opening import quiet_usd
from icheat_usd.stage.refusals import named_refusals
from icheat_usd.stage.stacks import EditFinding

__all__ = ["RULES", "Context", "Rule", "check_stage", "findings_of"]

RULES: tuple[Rule, ...] = (
    schemas.SchemasNotRegistered(),
    schemas.SchemaOnWrongType(),
    schemas.UnknownAttribute(),
    schemas.WrongAttributeType(),
    stacks.StackOutsideDefaultPrim(),
    stacks.StackInInstance(),
    stacks.UnusableTarget(),
    stacks.EditListedTwice(),
    stacks.EditInNoStack(),
    stacks.CameraIsNoCamera(),
    stacks.TargetDropped(),
    edits.UnknownOperation(),
    edits.OperationSchemaNotApplied(),
    schemas.UnknownToken(),
    schemas.NotFinite(),
    selections.EmptySelection(),
    selections.SelectedPrimMissing(),
    selections.SelectionInCircle(),
    selections.RegionIsRendered(),
    selections.RegionWithoutSpace(),
    selections.UnshadowWithoutOccluders(),
    selections.LightsWithoutEffect(),
    selections.SeveralTargets(),
    selections.LightIsNoLight(),
    edits.SeveralAnchors(),
    keys.PayloadWithoutFile(),
    keys.FileWithoutPayload(),
    keys.KeysFromTwoLayers(),
    keys.KeyTimesDiffer(),
    keys.KeysFromClips(),
    keys.MissingSidecar(),
    keys.UnanchoredFile(),
    keys.CopiedKeysOutdated(),
    baked.BakedWithoutPayload(),
    baked.BakedStale(),
    baked.BakedForOtherCamera(),
    baked.BakedParametersChanged(),
    baked.PaintedSurfaceChanged(),
)


@named_refusals
def check_stage(
    stage: Usd.Stage, time: float | None = None, read_payload: PayloadReader | None = None
) -> list[EditFinding]:
    """Everything that is wrong with the edits on a stage, in order of rule and prim.

    Parameters
    ----------
    time
        Time code at which values are read, by default the stage's start; keys and samples are all looked at.
    read_payload
        Given one, every payload is read, and those that are baked are compared with the scene.
    """
    with quiet_usd():  # USD warns on stderr about dropped targets, each time it composes them.
        context = look_at(stage, time, read_payload)
        return [finding for rule in RULES for finding in findings_of(rule, context)]


def findings_of(rule: Rule, context: Context) -> list[EditFinding]:
    """What one rule finds."""
    return [
        EditFinding(str(prim.GetPath()), name, message, rule.severity, type(rule).__name__)
        for prim, name, message in rule.find(context)
    ]
