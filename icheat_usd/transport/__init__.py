"""The transport operator: building, bounces, compression."""

from icheat_usd.transport.bounces import (
    Bounces,
    CellLight,
    build_bounces,
    light_cells,
    more_bounces,
    solve_bounces,
    sum_groups,
    sum_lights,
)
from icheat_usd.transport.build import Lobe, Transport, build_transport
from icheat_usd.transport.held_back import HeldBack
from icheat_usd.transport.packed import LargeTerms, PackedLobe, PackedRows, PackedTransport, PackingReport
from icheat_usd.transport.packing import lossless, pack
from icheat_usd.transport.progressive import build_transports
from icheat_usd.transport.records import RecordSettings
from icheat_usd.transport.residual import residual
from icheat_usd.transport.sparse import SparseRows
from icheat_usd.transport.training import training_radiance

__all__ = [
    "Bounces",
    "CellLight",
    "HeldBack",
    "LargeTerms",
    "Lobe",
    "PackedLobe",
    "PackedRows",
    "PackedTransport",
    "PackingReport",
    "RecordSettings",
    "SparseRows",
    "Transport",
    "build_bounces",
    "more_bounces",
    "build_transport",
    "build_transports",
    "light_cells",
    "lossless",
    "pack",
    "residual",
    "solve_bounces",
    "sum_groups",
    "sum_lights",
    "training_radiance",
]
