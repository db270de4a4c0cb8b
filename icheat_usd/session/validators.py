"""Registers the rules of `icheat check` with UsdValidation; USD imports this when a tool asks for validators.

schemas/validation/plugInfo.json announces it. Running the module writes that
file anew from the rules.
"""

from __future__ import annotations

import json

from icheat_usd.resources import resource_path
from icheat_usd.session.authoring import read_payload
from icheat_usd.stage import validation

MODULE = "icheat_usd.session.validators"

PLUGIN = "schemas/validation/plugInfo.json"


def plugin_text() -> str:
    """What the plug-in's description should say."""
    return json.dumps(validation.plugin_description(MODULE), indent=4, sort_keys=True) + "\n"


if __name__ == "__main__":
    resource_path("schemas/validation").joinpath("plugInfo.json").write_text(plugin_text())
else:
    validation.register(MODULE, read_payload)
