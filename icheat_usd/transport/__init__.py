"""The transport operator: building, bounces, compression."""

from icheat_usd.transport.bounces import Bounces, CellLight, build_bounces, light_cells, solve_bounces, sum_lights
from icheat_usd.transport.build import Lobe, Transport, build_transport
from icheat_usd.transport.compress import CompressedRows, compress_rows
from icheat_usd.transport.sparse import SparseRows

__all__ = [
    "Bounces",
    "CellLight",
    "CompressedRows",
    "Lobe",
    "SparseRows",
    "Transport",
    "build_bounces",
    "build_transport",
    "compress_rows",
    "light_cells",
    "solve_bounces",
    "sum_lights",
]
