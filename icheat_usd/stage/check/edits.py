"""Rules about single edits."""

from __future__ import annotations

from icheat_usd.edits.operations import BAKED
from icheat_usd.errors import EditError
from icheat_usd.stage import schema
from icheat_usd.stage.check.rule import Context, Found, Rule
from icheat_usd.stage.edit_stack import anchor_path
from icheat_usd.stage.keys import strongest_opinion
from icheat_usd.stage.stacks import Severity


class UnknownOperation(Rule):
    doc = "An edit's operation is known, or it has a baked payload."

    def find(self, context: Context) -> Found:
        known = schema.operations()
        for prim in context.edits:
            operation = schema.read_attribute(prim, schema.OPERATION, context.time)
            if (
                operation in known
                or operation == BAKED
                or strongest_opinion(prim.GetAttribute(schema.PAYLOAD)) is not None
            ):
                continue
            listed = ", ".join(sorted(known))
            yield prim, schema.OPERATION, f"'{operation}' is unknown here and there is no payload; known are {listed}"


class OperationSchemaNotApplied(Rule):
    doc = "An edit has its operation's schema, so that hosts show its parameters."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            operation = schema.operations().get(schema.read_attribute(prim, schema.OPERATION, context.time))
            has_own = operation is not None and any(prim.GetAttribute(p.name) for p in operation.parameters.values())
            if operation is not None and has_own and not schema.has_schema(prim, operation.api_schema):
                yield prim, schema.OPERATION, f"'{operation.name}' is set without {operation.api_schema}; apply it"


class SeveralAnchors(Rule):
    doc = "An edit has one anchor at most."

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            try:
                anchor_path(prim)
            except EditError as error:
                yield prim, schema.ANCHOR, str(error)
