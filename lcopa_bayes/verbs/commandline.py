"""How the command line is read: wrong words name the nearest right one, and JSON is answered in JSON."""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NoReturn

from lcopa_bayes.core.errors import nearest

PROGRAM = "lcopa-bayes"
"""Name of the command and of the distribution."""
USAGE_ERROR = 2
"""Exit code for input that cannot be used."""


def refused(problems: Sequence[str], *, as_json: bool) -> int:
    """Print what is wrong with the input; the exit code."""
    if as_json:
        print(json.dumps({"errors": list(problems)}))
    else:
        for problem in problems:
            print(f"error: {problem}", file=sys.stderr)
    return USAGE_ERROR


class CommandParser(argparse.ArgumentParser):
    """A parser that names the nearest known word, and complains in JSON where JSON was asked for."""

    given: Sequence[str] = ()
    """The command line."""
    verbs: Mapping[str, CommandParser] = MappingProxyType({})
    """Parsers of the verbs, where this one knows them."""

    def error(self, message: str) -> NoReturn:
        """Print what is wrong with the command line and exit."""
        verb = next((one for one in self.given if not one.startswith("-")), "")
        unknown = re.search(r"unrecognized arguments: (--?\S+)", message)
        if verb and self.verbs and verb not in self.verbs:
            message = f"{verb!r} is not a verb{nearest(verb, self.verbs)}"
        elif unknown and verb in self.verbs:
            options = re.findall(r"--[\w-]+", self.verbs[verb].format_help())
            message = f"{unknown[1]} is not an option of {verb}{nearest(unknown[1], options)}"
        elif "--json" not in self.given:
            self.print_usage(sys.stderr)
        raise SystemExit(refused([message], as_json="--json" in self.given))


class Version(argparse.Action):
    """Prints the version, which is looked up when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        """Print it and exit."""
        from importlib.metadata import version

        print(f"{PROGRAM} {version(PROGRAM)}")
        parser.exit()
