"""Rules about keys and the files that hold their payloads."""

from __future__ import annotations

from pxr import Sdf

from icheat_usd.errors import EditError, IcheatError
from icheat_usd.stage import key_authoring, schema
from icheat_usd.stage.check.rule import Context, Found, Rule
from icheat_usd.stage.keys import SAME_TIME, Opinion, comes_from_clips, read_keys, strongest_opinion
from icheat_usd.stage.stacks import Severity


class PayloadWithoutFile(Rule):
    doc = "A payload says which file holds it."

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            payload = strongest_opinion(prim.GetAttribute(schema.PAYLOAD))
            if payload is None or payload.is_blocked or _only_blocks(payload):
                continue
            file = strongest_opinion(prim.GetAttribute(schema.FILE_PATH))
            if file is None or (file.is_blocked and file.layer == payload.layer):
                where = payload.layer.identifier
                yield prim, schema.PAYLOAD, f"is authored in {where} without {schema.FILE_PATH}; author both there"


class FileWithoutPayload(Rule):
    doc = "A sidecar file comes with the payload to take from it."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            file = strongest_opinion(prim.GetAttribute(schema.FILE_PATH))
            if file is not None and strongest_opinion(prim.GetAttribute(schema.PAYLOAD)) is None:
                yield prim, schema.FILE_PATH, f"has no effect without {schema.PAYLOAD}; author both"


class KeysFromTwoLayers(Rule):
    doc = "File and payload are decided by the same layer."

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            payload = strongest_opinion(prim.GetAttribute(schema.PAYLOAD))
            file = strongest_opinion(prim.GetAttribute(schema.FILE_PATH))
            if payload and file and not payload.is_blocked and payload.layer != file.layer:
                message = (
                    f"is decided by {payload.layer.identifier} but {schema.FILE_PATH} by {file.layer.identifier}; "
                    f"author both in the same layer"
                )
                yield prim, schema.PAYLOAD, message


class KeyTimesDiffer(Rule):
    doc = "File and payload have time samples at the same times."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            payload = strongest_opinion(prim.GetAttribute(schema.PAYLOAD))
            file = strongest_opinion(prim.GetAttribute(schema.FILE_PATH))
            if not payload or not file or payload.layer != file.layer or file.source != "timeSamples":
                continue
            times = [o.layer.ListTimeSamplesForPath(o.path) for o in (payload, file)]
            same = len(times[0]) == len(times[1])
            if not same or any(abs(a - b) > SAME_TIME for a, b in zip(*times, strict=True)):
                yield prim, schema.FILE_PATH, f"has other sample times than {schema.PAYLOAD}; sample both together"


class KeysFromClips(Rule):
    doc = "Keys are authored in layers, not in value clips."

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            for name in (schema.PAYLOAD, schema.FILE_PATH):
                if comes_from_clips(prim.GetAttribute(name)):
                    yield prim, name, "comes from value clips, so the edit cannot be read; author its keys in a layer"


class MissingSidecar(Rule):
    doc = "Every key's file exists, and holds its payload where a reader is given."

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            try:
                track = read_keys(prim)
            except EditError:
                continue  # Other rules say why.
            seen = set()
            for key in track.keys if track else ():
                if not key.digest or (key.anchored, key.digest) in seen:
                    continue
                seen.add((key.anchored, key.digest))
                try:
                    context.payload(prim, key)
                except IcheatError as error:
                    yield prim, schema.FILE_PATH, str(error)


class UnanchoredFile(Rule):
    doc = "A layer without a file names sidecar files absolutely."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            file = strongest_opinion(prim.GetAttribute(schema.FILE_PATH))
            if file is None or not file.layer.anonymous:
                continue
            asset = prim.GetAttribute(schema.FILE_PATH).Get(schema.time_code(context.time))
            if asset and asset.path and not asset.path.startswith("/") and "://" not in asset.path:
                message = f"'{asset.path}' is relative in {file.layer.identifier}, which has no place; save the layer"
                yield prim, schema.FILE_PATH, message


class CopiedKeysOutdated(Rule):
    doc = "Keys that a layer copied still equal those of the layer they came from."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            state = key_authoring.copied_keys_are_current(prim)
            if state is not None and not state[1]:
                yield prim, schema.PAYLOAD, f"keys were copied from {state[0]}, which has changed; copy them again"


def _only_blocks(payload: Opinion) -> bool:
    """Whether all keys are the identity, which no file holds."""
    samples = payload.layer.ListTimeSamplesForPath(payload.path) if payload.source == "timeSamples" else []
    values = [payload.layer.QueryTimeSample(payload.path, time) for time in samples]
    return bool(values) and all(isinstance(value, Sdf.ValueBlock) for value in values)
