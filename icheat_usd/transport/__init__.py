"""The transport operator: building, bounces, compression."""

from icheat_usd.transport.build import Lobe, Transport, build_transport, solve_bounces
from icheat_usd.transport.compress import CompressedRows, compress_rows
from icheat_usd.transport.sparse import SparseRows

__all__ = ["CompressedRows", "Lobe", "SparseRows", "Transport", "build_transport", "compress_rows", "solve_bounces"]
