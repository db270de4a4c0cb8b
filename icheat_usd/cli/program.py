"""Edit, preview and render indirect light in USD stages."""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import traceback
from importlib import import_module
from typing import Any, NoReturn

from icheat_usd import __version__
from icheat_usd.cli.interrupts import lost_interrupts_again
from icheat_usd.errors import IcheatError

#: Modules of `icheat_usd.cli`, in the order of the help; each has a docstring (its help), `setup_parser` and `command`.
VERBS = (
    "demo",
    "relight",
    "render",
    "stack",
    "edit",
    "key",
    "bake",
    "region",
    "selection",
    "tree",
    "cat",
    "diff",
    "explain",
    "stats",
    "check",
    "plugin_path",
    "pack",
    "publish",
    "upgrade",
    "gc",
    "history",
    "cache",
    "warm",
)

CLEAN, FINDINGS, FAILURE, INTERRUPTED = 0, 1, 2, 130

_EPILOG = "Exit status: 0 clean, 1 findings, 2 failure, 130 interrupted. `icheat VERB --help` tells more."


class Parser(argparse.ArgumentParser):
    """Parser of the program and of each verb: mistakes are one line, and numbers may begin with a minus."""

    def __init__(self, *args: Any, **values: Any) -> None:
        super().__init__(*args, **values)
        # As in newer versions of argparse: "-1,0.5,2" is a value and no option.
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def error(self, message: str) -> NoReturn:
        """End with one line; the usage of some verbs has twenty."""
        raise UsageError(f"{self.prog}: error: {message}; `{self.prog} --help` tells more")


class UsageError(SystemExit):
    """The command line says something that the program does not know."""


def build_parser() -> argparse.ArgumentParser:
    """The whole command line; verbs import their libraries only when they run."""
    parser = Parser(prog="icheat", description=__doc__, epilog=_EPILOG)
    parser.add_argument("--version", action="version", version=f"icheat {__version__}")
    parser.add_argument("--traceback", action="store_true", help="show where in the program an error arose")
    verbs = parser.add_subparsers(title="verbs", metavar="VERB", required=True)
    for name in VERBS:
        module = import_module(f"icheat_usd.cli.{name}")
        add_verb(verbs, name.replace("_", "-"), module)
    return parser


def add_verb(verbs: argparse._SubParsersAction[Any], name: str, module: object) -> None:
    doc = str(module.__doc__).strip()
    verb = verbs.add_parser(
        name,
        help=doc.splitlines()[0].rstrip("."),
        description=doc,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    module.setup_parser(verb)  # type: ignore[attr-defined]
    if hasattr(module, "command"):
        verb.set_defaults(command=module.command)


def run(arguments: list[str] | None = None) -> int:
    """Run one command line; every failure becomes one line on stderr and an exit status."""
    try:
        return _run(sys.argv[1:] if arguments is None else arguments)
    except KeyboardInterrupt:
        print("\nicheat: interrupted; nothing was left half-written", file=sys.stderr)
        return INTERRUPTED


def _run(given: list[str]) -> int:
    try:
        options = build_parser().parse_args(given)
        options.given = given
    except UsageError as error:
        print(error, file=sys.stderr)
        if "--json" in given:
            print(json.dumps({"version": 1, "error": str(error)}))
        return FAILURE
    except SystemExit as end:  # --help, --version
        return int(end.code or 0)
    try:
        with lost_interrupts_again():
            status = int(options.command(options))
        sys.stdout.flush()
        return status
    except BrokenPipeError:
        # The reader left (`icheat tree … | head`). Keep the interpreter's last flush from complaining about it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return CLEAN
    except IcheatError as error:
        return _fail(options, str(error))
    except OSError as error:
        return _fail(options, f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except ModuleNotFoundError as error:
        return _fail(
            options, f"this needs the package '{error.name}', which is not installed here; pip install {error.name}"
        )
    except MemoryError:
        return _fail(options, "out of memory; lower --width and --height or the quality")
    except Exception as error:
        # A mistake in this program. Python would exit with 1, which here means "findings".
        traceback.print_exc()
        return _fail(
            options, f"internal error ({type(error).__name__}: {error}); please report it with the lines above"
        )


def _fail(options: argparse.Namespace, message: str) -> int:
    if options.traceback:
        traceback.print_exc()
    line = " ".join(message.split())
    print(f"icheat: error: {line}", file=sys.stderr)
    if getattr(options, "json", False):
        print(json.dumps({"version": 1, "error": line}))
    return FAILURE
