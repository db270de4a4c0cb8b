"""Sidecar files: painted and baked payloads of edits in write-once HDF5. The format is schemas/sidecar/SPEC.md."""

from icheat_usd.sidecar.canonical import Element
from icheat_usd.sidecar.elements import payload_digest
from icheat_usd.sidecar.reader import (
    MAX_PAYLOAD_BYTES,
    ElementInfo,
    History,
    describe,
    list_elements,
    list_payloads,
    read_history,
    read_payload,
)
from icheat_usd.sidecar.writer import pack, write_payloads

__all__ = [
    "MAX_PAYLOAD_BYTES",
    "Element",
    "ElementInfo",
    "History",
    "describe",
    "list_elements",
    "list_payloads",
    "pack",
    "payload_digest",
    "read_history",
    "read_payload",
    "write_payloads",
]
