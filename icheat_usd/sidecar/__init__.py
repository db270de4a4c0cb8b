"""Sidecar files: painted and baked payloads of edits in write-once HDF5. The format is schemas/sidecar/SPEC.md."""

from icheat_usd.sidecar.canonical import Element
from icheat_usd.sidecar.copying import pack, upgrade
from icheat_usd.sidecar.elements import payload_digest
from icheat_usd.sidecar.guarded import MAX_PAYLOAD_BYTES
from icheat_usd.sidecar.reader import (
    ElementInfo,
    History,
    describe,
    is_published,
    list_aliases,
    list_elements,
    list_payloads,
    read_history,
    read_payload,
)
from icheat_usd.sidecar.writer import SUFFIX, write_payloads

__all__ = [
    "MAX_PAYLOAD_BYTES",
    "SUFFIX",
    "Element",
    "ElementInfo",
    "History",
    "describe",
    "is_published",
    "list_aliases",
    "list_elements",
    "list_payloads",
    "pack",
    "payload_digest",
    "read_history",
    "read_payload",
    "upgrade",
    "write_payloads",
]
