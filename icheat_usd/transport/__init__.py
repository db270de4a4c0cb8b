"""The transport operator: building, bounces, compression."""

from icheat_usd.transport.bounces import (
    Bounces,
    CellLight,
    build_bounces,
    light_cells,
    solve_bounces,
    sum_groups,
    sum_lights,
)
from icheat_usd.transport.build import Lobe, Transport, build_transport
from icheat_usd.transport.compress import CompressedRows, compress_rows
from icheat_usd.transport.held_back import HeldBack
from icheat_usd.transport.sparse import SparseRows

__all__ = [
    "Bounces",
    "CellLight",
    "CompressedRows",
    "HeldBack",
    "Lobe",
    "SparseRows",
    "Transport",
    "build_bounces",
    "build_transport",
    "compress_rows",
    "light_cells",
    "solve_bounces",
    "sum_groups",
    "sum_lights",
]
