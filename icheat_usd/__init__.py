"""Artistic control of indirect light, in USD."""

from __future__ import annotations

__version__ = "0.1.0"
