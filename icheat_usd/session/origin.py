"""Who makes a payload, when, and why: what sidecars keep as history."""

from __future__ import annotations

import getpass
import os
import socket
from datetime import UTC, datetime

from icheat_usd.sidecar import History


def history_entry(why: str = "", edit: str = "") -> History:
    """An entry about what is being written now.

    `ICHEAT_USER` names whoever works through a shared account.
    """
    return History(who=_user(), why=why, when=datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"), edit=edit)


def _user() -> str:
    try:
        name = os.environ.get("ICHEAT_USER") or getpass.getuser()
    except (KeyError, OSError, ImportError):  # a user id without a name, as in containers
        name = str(os.getuid()) if hasattr(os, "getuid") else "unknown"
    return name if "@" in name else f"{name}@{socket.gethostname()}"
