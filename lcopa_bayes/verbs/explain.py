"""`explain`: a term in three lines, with an example from the last fit."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lcopa_bayes.core.errors import InputError, nearest

if TYPE_CHECKING:
    from lcopa_bayes.model.effects.effect import Card


def explain(term: str, *, runs: Path | str = "runs") -> str:
    """What a term of pages and messages means, in at most three lines, and an example; of an effect its
    formula, and what shows it.

    Parameters: `term`, in any case, or a word close to it; `runs`, folder of run folders, of which the last
    fit gives the example. InputError for an unknown term, with the nearest known one.
    """
    glossary: Mapping[str, Mapping[str, Any]] = tomllib.loads(
        files("lcopa_bayes.verbs").joinpath("glossary.toml").read_text(encoding="utf-8")
    )
    names = {word.casefold(): name for name, one in glossary.items() for word in (name, *one["words"])}
    wanted = term.casefold().strip()
    if wanted not in names:
        from lcopa_bayes.model.effects.catalogue import catalogue  # takes seconds to load

        effects = {name.casefold(): kind.card for name, kind in catalogue().items()}
        effect = wanted.replace(" ", "_")
        if effect in effects:
            return _effect(effects[effect])
        hint = nearest(wanted, [*names, *effects])
        hint = hint if "did you mean" in hint else nearest(wanted, glossary)
        raise InputError(f"{term!r} is not a known term{hint}")
    entry = glossary[names[wanted]]
    parts = [f"{names[wanted]}: {entry['text'].strip()}", _example(entry["example"], Path(runs))]
    return "\n".join(part for part in parts if part)


def _effect(card: Card) -> str:
    """An effect of the catalogue in three lines."""
    acting = "without a name" if card.place == "generic" else f"that acts on the {card.place}"
    return (
        f"{card.name}: an effect {acting}: {card.formula}.\n"
        f"Shown by {card.reveals}; else mistaken for {card.mistaken_for}.\n"
        f"Source: {card.source}."
    )


def _example(sentence: str, runs: Path) -> str:
    """The sentence with the numbers of the last fit; empty without one."""
    fits = sorted(runs.glob("*/results.json"), key=lambda path: path.stat().st_mtime)
    if not (sentence and fits):
        return ""
    try:
        values = json.loads(fits[-1].read_text(encoding="utf-8"))
        return f"Example, {fits[-1].parent}: " + sentence.format(**values, **_words(values))
    except (OSError, ValueError, KeyError, TypeError):  # of another version, or without this number
        return ""


def _words(values: Mapping[str, Any]) -> dict[str, str]:
    """A parameter of each kind with its interval, and a held-out score."""
    out: dict[str, str] = {}
    for row in values["parameters"]:
        ends = ["open" if row[end] is None else f"{row[end]:.4g}" for end in ("lower", "upper")]
        said = f"{row['name']} = {row['value']:.4g} ({ends[0]} to {ends[1]}) {row['unit']}"
        out.setdefault(row["name"].partition("_")[0], said)
    for row in values["held_out"][:1]:
        out["held"] = f"{100 * row['coverage_90']:.0f} % of {row['record']}/{row['axis']} in the 90 % band"
    return out
