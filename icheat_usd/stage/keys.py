"""Keyframes of an edit: which payload holds at which stage time.

Keys are read from the time samples of the spec that wins, and mapped to stage
time by its layer offset. ``Usd.Attribute.Get`` at a bracketing time is not
used for this: under an offset with a scale the mapped time rounds, and the
value that is held at the rounded time may be the neighbour's.
"""

from __future__ import annotations

import bisect
import hashlib
from dataclasses import dataclass
from enum import StrEnum

from pxr import Sdf, Usd

from icheat_usd.errors import EditError
from icheat_usd.stage import schema

#: Two times closer than this, in frames, are one: far above rounding of a mapped time, far below a shutter.
SAME_TIME = 1e-6


class Interpolation(StrEnum):
    """What happens between two keys."""

    LINEAR = "linear"  #: a straight line
    SMOOTH = "smooth"  #: eased at both ends: no speed at a key
    HELD = "held"  #: the earlier key holds


@dataclass(frozen=True)
class Opinion:
    """The spec that decides an attribute's value."""

    layer: Sdf.Layer
    path: Sdf.Path
    offset: Sdf.LayerOffset  #: layer time to stage time
    source: str  #: "timeSamples", "spline" or "default"
    is_blocked: bool = False  #: a blocked default: hides weaker layers and yields the fallback


@dataclass(frozen=True)
class Key:
    """One keyframe. No digest is the identity."""

    time: float | None  #: stage time; None where a default value stands for all times
    digest: str
    file: str = ""  #: as authored, expression variables evaluated
    resolved: str = ""  #: "" where the resolver finds no file
    anchored: str = ""  #: where the file was looked for


@dataclass(frozen=True)
class KeyTrack:
    """All keys of one edit, in order of time; at least one."""

    keys: tuple[Key, ...]
    interpolation: Interpolation
    layer: str  #: identifier of the layer whose opinion won

    @property
    def times(self) -> tuple[float, ...]:
        return tuple(key.time for key in self.keys if key.time is not None)

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of times, payloads and interpolation: changes when the track does."""
        text = repr([(None if key.time is None else round(key.time, 6), key.digest) for key in self.keys])
        # Layers keep digests of keys that they copied, from when there was but a flag: held or not.
        between = {Interpolation.LINEAR: "False", Interpolation.HELD: "True"}.get(self.interpolation, "smooth")
        return hashlib.sha256(f"{text}{between}".encode()).hexdigest()

    def at(self, time: float | None) -> tuple[tuple[Key, float], ...]:
        """The one or two keys that hold at a stage time, with weights that sum to 1.

        Before the first key and after the last, these hold. Without a time the first holds.
        """
        times = self.times
        if time is None or not times or time <= times[0] + SAME_TIME:
            return ((self.keys[0], 1.0),)
        low = bisect.bisect_right(times, time + SAME_TIME) - 1
        if low == len(times) - 1 or self.interpolation is Interpolation.HELD or time <= times[low] + SAME_TIME:
            return ((self.keys[low], 1.0),)
        if self.keys[low].digest == self.keys[low + 1].digest:
            return ((self.keys[low], 1.0),)
        weight = (time - times[low]) / (times[low + 1] - times[low])
        if self.interpolation is Interpolation.SMOOTH:
            weight = weight * weight * (3.0 - 2.0 * weight)
        return ((self.keys[low], 1.0 - weight), (self.keys[low + 1], weight))


def strongest_opinion(attribute: Usd.Attribute, time: float | None = None) -> Opinion | None:
    """The spec that decides the attribute's value at a time, None where nothing is authored.

    Of value clips that decide, the layer is the clip's, at the clip's times.
    """
    if not attribute:
        return None
    for spec, offset in attribute.GetPropertyStackWithLayerOffsets(schema.time_code(time)):
        if spec.layer.GetNumTimeSamplesForPath(spec.path) > 0:
            return Opinion(spec.layer, spec.path, offset, "timeSamples")
        if spec.HasInfo("spline"):
            return Opinion(spec.layer, spec.path, offset, "spline")
        if spec.HasInfo("default"):
            return Opinion(spec.layer, spec.path, offset, "default", isinstance(spec.default, Sdf.ValueBlock))
    return None


def comes_from_clips(attribute: Usd.Attribute, time: float | None = None) -> bool:
    """Whether value clips decide the attribute's value at a time."""
    source = attribute.GetResolveInfo(schema.time_code(time)).GetSource() if attribute else None
    return bool(source == Usd.ResolveInfoSourceValueClips)


def read_keys(prim: Usd.Prim) -> KeyTrack | None:
    """The composed keys of an edit, None where it has no payload.

    Raises
    ------
    EditError
        The payload has no file, file and payload are decided by different layers or at different times, or no
        interpolation is called as it says.
    """
    payload = prim.GetAttribute(schema.PAYLOAD)
    opinion = strongest_opinion(payload)
    for name in (schema.PAYLOAD, schema.FILE_PATH):
        if comes_from_clips(prim.GetAttribute(name)):
            raise EditError(f"{prim.GetPath()}: {name} comes from value clips; author its keys in a layer")
    if opinion is None:
        return None
    interpolation = read_interpolation(prim)
    identifier = opinion.layer.identifier
    if opinion.is_blocked:
        return KeyTrack((Key(None, ""),), interpolation, identifier)
    file_opinion = strongest_opinion(prim.GetAttribute(schema.FILE_PATH))
    if file_opinion is not None and file_opinion.layer != opinion.layer:
        raise EditError(
            f"{prim.GetPath()}: {schema.PAYLOAD} is decided by {identifier} but {schema.FILE_PATH} by "
            f"{file_opinion.layer.identifier}; author both in the same layer"
        )
    if opinion.source == "default":
        digest = opinion.layer.GetAttributeAtPath(opinion.path).default
        return KeyTrack((_key(prim, None, str(digest), file_opinion, None),), interpolation, identifier)
    keys = []
    for layer_time in opinion.layer.ListTimeSamplesForPath(opinion.path):
        value = opinion.layer.QueryTimeSample(opinion.path, layer_time)
        digest = "" if isinstance(value, Sdf.ValueBlock) else str(value)
        keys.append(_key(prim, opinion.offset * layer_time, digest, file_opinion, layer_time))
    return KeyTrack(tuple(keys), interpolation, identifier)


def read_interpolation(prim: Usd.Prim) -> Interpolation:
    """What happens between the keys of an edit.

    Raises
    ------
    EditError
        The token is unknown.
    """
    token = schema.read_attribute(prim, schema.KEY_INTERPOLATION, None)
    try:
        return Interpolation(token)
    except ValueError:
        known = ", ".join(Interpolation)
        raise EditError(f"{prim.GetPath()}: {schema.KEY_INTERPOLATION} is '{token}', expected one of {known}") from None


def _key(
    prim: Usd.Prim, time: float | None, digest: str, file_opinion: Opinion | None, layer_time: float | None
) -> Key:
    if not digest:
        return Key(time, "")
    if file_opinion is None or file_opinion.is_blocked:
        raise EditError(f"{prim.GetPath()}: {schema.PAYLOAD} is authored without {schema.FILE_PATH}; author both")
    if file_opinion.source == "timeSamples" and layer_time is None:
        raise EditError(
            f"{prim.GetPath()}: {schema.FILE_PATH} has time samples in {file_opinion.layer.identifier} but "
            f"{schema.PAYLOAD} has none; sample both at the same times"
        )
    asset = prim.GetAttribute(schema.FILE_PATH).Get(_asset_time(file_opinion, layer_time))
    if not isinstance(asset, Sdf.AssetPath) or not asset.path:
        at = "" if time is None else f" at time {time:g}"
        raise EditError(f"{prim.GetPath()}: {schema.FILE_PATH} names no file{at}; author it with {schema.PAYLOAD}")
    anchored = asset.resolvedPath or Sdf.ComputeAssetPathRelativeToLayer(file_opinion.layer, asset.path)
    return Key(time, digest, asset.path, asset.resolvedPath, anchored)


def _asset_time(opinion: Opinion, layer_time: float | None) -> Usd.TimeCode:
    """A stage time safely inside the interval that holds the asset sample of `layer_time`.

    The attribute is asked, not the spec, because it anchors, evaluates
    expression variables and resolves. Assets are always held, so the middle of
    the interval gives the sample, whatever rounding the mapped time suffers.
    """
    if layer_time is None or opinion.source != "timeSamples":
        return schema.time_code(None)
    samples = opinion.layer.ListTimeSamplesForPath(opinion.path)
    index = max(bisect.bisect_right(samples, layer_time) - 1, 0)
    following = samples[index + 1] if index + 1 < len(samples) else samples[index] + 1.0
    return Usd.TimeCode(opinion.offset * ((samples[index] + following) / 2.0))
