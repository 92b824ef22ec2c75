"""Files that appear whole or not at all, and files of tables."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lcopa_bayes.core.errors import ELSEWHERE, REMEDIES, InputError, UntrustedError, nearest
from lcopa_bayes.core.estimate import plain

if TYPE_CHECKING:
    import pandas as pd

UNFINISHED = ".part-"
"""How names of files begin that are being written."""
_DOTS = 200
"""Parts of the longest key of a TOML file: the time to read one grows with their square."""
_FORMULA = re.compile(r"'*(?:[=@\t\r]|[+-](?![\d.eE+-]*\Z))")
"""How a text begins that a spreadsheet takes for a formula, or that `csv_of` made of one."""
_TRUSTED: ContextVar[bool] = ContextVar("_TRUSTED", default=False)
_COMMAND: ContextVar[tuple[str, ...]] = ContextVar("_COMMAND", default=())
_TRUST = "if you trust its author, allow this with --trust, from Python with `load_study(..., trust=True)`"
_REMEDY = f"make it writable {ELSEWHERE}"


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a file beside `path`, then rename it into place; on failure `path` is untouched.

    Raises InputError with file, reason and remedy when the system refuses (disk full, no permission,
    file too large); what else `write` raises passes through. No temporary file is left either way.
    """
    with writing(path):
        handle, name = tempfile.mkstemp(
            dir=path.parent, prefix=f"{UNFINISHED}{path.stem}-", suffix=path.suffix
        )
        os.close(handle)
        beside = Path(name)
        try:
            write(beside)
            with beside.open("r+b") as file:
                os.fsync(file.fileno())  # a full network disk or quota may speak up only now
            beside.chmod(0o644)
            os.replace(beside, path)
        finally:
            beside.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """`write_whole` for text in UTF-8."""
    write_whole(path, lambda beside: beside.write_text(text, encoding="utf-8"))


def save_table(table: pd.DataFrame, path: Path) -> None:
    """Write a table as CSV; see `csv_of`."""
    write_text(path, csv_of(table))


def csv_of(table: pd.DataFrame, **how: Any) -> str:
    """A table as CSV, which a spreadsheet takes for no formula whatever records and axes are called."""
    safe = table.copy(deep=False)
    for name in table.select_dtypes(exclude=["number", "bool"]):
        taken = [isinstance(cell, str) and _FORMULA.match(cell) is not None for cell in table[name]]
        if any(taken):
            safe[name] = table[name].mask(np.array(taken), "'" + table[name].astype(str))
    return str(safe.to_csv(index=False, **how))


def as_named(cell: str) -> str:
    """A text of `csv_of` as it was."""
    return cell[1:] if cell[:1] == "'" and _FORMULA.match(cell) else cell


def save_json(values: Mapping[str, Any], path: Path) -> None:
    """Write plain values as JSON."""
    write_text(path, json.dumps(plain(values), indent=1, allow_nan=False) + "\n")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Within it, what the system refuses becomes an InputError about `path`."""
    try:
        yield
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error) or type(error).__name__
        remedy = REMEDIES.get(error.errno or 0, _REMEDY)
        raise InputError(f"{path}: cannot be written ({reason}); {remedy}") from error


def writable_folder(path: Path) -> Path:
    """`path` as a folder that can be written to, made if need be; InputError otherwise."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path, prefix=UNFINISHED):
            pass
    except OSError as error:
        raise InputError(
            f"{path}: the output folder cannot be written to ({error.strerror or error}); "
            "choose another with --out"
        ) from None
    return path


@contextmanager
def trusting(trust: bool) -> Iterator[None]:
    """Within it, where `trust` is true, studies may name files outside their folder and code to run."""
    before = _TRUSTED.set(trust or _TRUSTED.get())
    try:
        yield
    finally:
        _TRUSTED.reset(before)


def outside(folder: Path, names: Iterable[str]) -> list[str]:
    """What is wrong with files that the study in a folder names: absolute paths and those that lead out of
    it, by links too; nothing where the study is trusted."""
    home = os.path.realpath(folder)
    return [
        f"{name!r} is not inside the folder of the study; copy the file there, or {_TRUST}"
        for name in ({}.fromkeys(names) if not _TRUSTED.get() else ())
        if "\0" not in name
        and (Path(name).is_absolute() or not Path(os.path.realpath(folder / name)).is_relative_to(home))
    ]


def refuse_code(where: str, names: Collection[str]) -> None:
    """UntrustedError where a study that is not trusted names classes of its own."""
    if names and not _TRUSTED.get():
        raise UntrustedError(f"{where}: would run code, {', '.join(names)}; read it, and {_TRUST}")


def remove_unfinished(folder: Path) -> None:
    """Remove what a killed process was about to write within a folder."""
    for one in [*folder.rglob(f"{UNFINISHED}*")]:
        shutil.rmtree(one) if one.is_dir() else one.unlink(missing_ok=True)


def read_json(path: Path, remedy: str) -> dict[str, Any]:
    """The JSON object in a file; InputError with the `remedy` when it cannot be read."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(values, dict):
            raise ValueError("no JSON object")
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read ({error}); {remedy}") from None
    return values


def read_tables(path: Path, known: Collection[str]) -> tuple[dict[str, Any], list[str]]:
    """Tables of a TOML file, and what is wrong with their names; InputError when it cannot be read."""
    if not path.exists():
        beside = (one.name for one in path.parent.glob("*.toml"))
        raise InputError(f"{path}: no such file{nearest(path.name, beside)}")
    try:
        text = path.read_text(encoding="utf-8-sig")
        if any(part.count(".") > _DOTS for part in re.split("[=,\n]", text)):
            raise ValueError(f"a key of more than {_DOTS} parts")
        tables = tomllib.loads(text)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as UTF-8 text ({error})") from error
    except (ValueError, RecursionError) as error:  # of a number of thousands of digits and deep brackets too
        end = f"at line {text.count(chr(10)) + 1}, the end of the file"
        why = str(error).replace("at end of document", end)
        raise InputError(f"{path}: is not valid TOML: {why}") from error
    wrong = [f"{path}: {_misplaced(key, value, known)}" for key, value in tables.items() if key not in known]
    return tables, wrong


def _misplaced(key: str, value: object, known: Collection[str]) -> str:
    """What is wrong with an entry that no table of a file is named like."""
    entries = value if isinstance(value, list) and value else [value]
    if all(isinstance(one, dict) for one in entries):
        return f"unknown table [{key}]{nearest(key, known)}"
    return f"key {key!r} stands above all tables; put it below the one it belongs to: [{'], ['.join(known)}]"


@contextmanager
def commanded(command: Sequence[str]) -> Iterator[None]:
    """Within it, files say that this command line asked for them."""
    token = _COMMAND.set(tuple(command))
    try:
        yield
    finally:
        _COMMAND.reset(token)


def command_line() -> tuple[str, ...]:
    """The command line being executed; empty when a function was called from Python."""
    return _COMMAND.get()
