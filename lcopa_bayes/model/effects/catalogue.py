"""Effects by name: those of the package, of installed packages and of a study's own files.

An installed package adds effects by entry points of the group ``lcopa_bayes.effects``; a study by
``[effects] add = ["file.py:Class"]``. Both must be concrete subclasses of a class of `effect` with a card.
"""

from __future__ import annotations

import importlib.util
import inspect
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

from lcopa_bayes.core.errors import InputError, nearest, refuse_if
from lcopa_bayes.model.effects import commands, dynamics, generic, parallel, records, response, sensor
from lcopa_bayes.model.effects.effect import Card, Effect

GROUP = "lcopa_bayes.effects"
"""Entry point group of effects in installed packages."""
_MODULES = (commands, dynamics, parallel, response, sensor, records, generic)


def bundled() -> dict[str, type[Effect]]:
    """Effects of this package by name."""
    known = {}
    for module in _MODULES:
        for _, kind in inspect.getmembers(module, inspect.isclass):
            if issubclass(kind, Effect) and kind.__module__ == module.__name__:
                known[kind.card.name] = kind
    return dict(sorted(known.items()))


def catalogue(add: Sequence[str] = (), folder: Path | None = None) -> dict[str, type[Effect]]:
    """All effects by name, with those of installed packages and of `add` (``file.py:Class`` in `folder`).

    Raises InputError with everything that cannot be used: files, classes, or two effects of one name.
    """
    known, problems = bundled(), []
    sources = [(f"entry point {point.name}", point.load) for point in entry_points(group=GROUP)]
    sources += [(f"[effects] add = {text!r}", partial(_from_file, text, folder)) for text in add]
    for where, load in sources:
        try:
            kind = load()
        except InputError as error:
            problems += [f"{where}: {problem}" for problem in error.problems]
            continue
        except Exception as error:  # whatever another author's module does on import
            problems.append(f"{where}: cannot be loaded ({type(error).__name__}: {error})")
            continue
        fit = inspect.isclass(kind) and issubclass(kind, Effect) and not inspect.isabstract(kind)
        if not (fit and isinstance(getattr(kind, "card", None), Card)):
            problems.append(f"{where}: must be a concrete Effect class with a `card`; got {kind!r}")
        elif kind.card.name in known:
            problems.append(f"{where}: an effect named {kind.card.name!r} exists; choose another name")
        else:
            known[kind.card.name] = kind
    refuse_if(problems)
    return known


def _from_file(text: str, folder: Path | None) -> object:
    """The class of ``file.py:Class``."""
    name, colon, wanted = text.rpartition(":")
    path = (folder or Path()) / name
    if not (colon and name.endswith(".py") and wanted.isidentifier()):
        raise InputError("expected file.py:Class")
    if not path.is_file():
        raise InputError(f"{path} is not a file")
    spec = importlib.util.spec_from_file_location(f"study file {path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with _importing(module):
        spec.loader.exec_module(module)
    if not hasattr(module, wanted):
        raise InputError(f"{path} has no {wanted!r}{nearest(wanted, vars(module))}")
    return getattr(module, wanted)


@contextmanager
def _importing(module: ModuleType) -> Iterator[None]:
    """List a module while it is executed, as dataclasses with annotations as text need it; not afterwards, so
    that no worker is sent its name, from which it could not be imported."""
    sys.modules[module.__name__] = module
    try:
        yield
    finally:
        del sys.modules[module.__name__]
