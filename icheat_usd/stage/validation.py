"""The rules of `icheat check` as validators that any tool built on UsdValidation finds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pxr import Usd

from icheat_usd.stage.check import RULES, Rule, findings_of
from icheat_usd.stage.check.rule import look_at
from icheat_usd.stage.edit_stack import PayloadReader
from icheat_usd.stage.opening import quiet_usd
from icheat_usd.stage.stacks import EditFinding, Severity

#: Keyword that selects all of them.
KEYWORD = "icheat"


def validator_name(rule: Rule) -> str:
    """Name of a rule's validator, without the plug-in's."""
    return type(rule).__name__


def plugin_description(module: str) -> dict[str, Any]:
    """Contents of the plugInfo.json that announces the validators, which `module` registers when it is imported."""
    validators: dict[str, Any] = {validator_name(rule): {"doc": rule.doc} for rule in RULES}
    info = {"Validators": {**validators, "keywords": [KEYWORD]}}
    return {"Plugins": [{"Info": info, "Name": module, "Root": ".", "Type": "python"}]}


def register(module: str, read_payload: PayloadReader | None = None) -> bool:
    """Register a validator for each rule under the plug-in called `module`; False where the host's USD has none.

    Parameters
    ----------
    read_payload
        Given one, payloads are read too.
    """
    try:
        from pxr import UsdValidation
    except ImportError:
        return False
    registry = UsdValidation.ValidationRegistry()
    if not hasattr(registry, "RegisterPluginStageValidator"):  # older than 26.5: C++ plug-ins only
        return False
    for rule in RULES:
        registry.RegisterPluginStageValidator(
            f"{module}:{validator_name(rule)}", _task(UsdValidation, rule, read_payload), []
        )
    return True


def _task(validation: Any, rule: Rule, read_payload: PayloadReader | None) -> Callable[[Usd.Stage, Any], list[Any]]:
    kinds = {
        Severity.ERROR: validation.ValidationErrorType.Error,
        Severity.WARNING: validation.ValidationErrorType.Warn,
    }

    def validate(stage: Usd.Stage, times: Any) -> list[Any]:
        with quiet_usd():
            found = findings_of(rule, look_at(stage, None, read_payload))
        return [
            validation.ValidationError(
                validator_name(rule), kinds[f.severity], [_site(validation, stage, f)], f.message
            )
            for f in found
        ]

    return validate


def _site(validation: Any, stage: Usd.Stage, finding: EditFinding) -> Any:
    path = stage.GetPseudoRoot().GetPath() if not finding.prim else stage.GetPrimAtPath(finding.prim).GetPath()
    prim = stage.GetPrimAtPath(path)
    has_property = bool(finding.feature) and prim and prim.HasProperty(finding.feature)
    return validation.ValidationErrorSite(stage, path.AppendProperty(finding.feature) if has_property else path)
