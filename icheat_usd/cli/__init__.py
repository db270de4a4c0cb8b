"""`icheat`: one module per verb, imported when its verb is used."""

from __future__ import annotations


def main(arguments: list[str] | None = None) -> int:
    """Run one `icheat` command line and return its exit status: 0 clean, 1 findings, 2 failure, 130 interrupted."""
    from icheat_usd.cli.program import run

    return run(arguments)
