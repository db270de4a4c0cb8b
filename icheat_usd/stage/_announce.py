"""Imported before anything else of this package: the plug-ins of other packages, announced before USD loads.

Ours are announced when `icheat_usd` is imported. Asking for others takes a
while, and nothing but a stage needs them.
"""

from __future__ import annotations

from icheat_usd.plugin_path import announce_packages

announce_packages()
