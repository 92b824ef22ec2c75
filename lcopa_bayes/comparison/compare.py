"""The verb `compare`: candidates fitted side by side, scored and decided."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lcopa_bayes.comparison.candidatefit import Contender, contender
from lcopa_bayes.comparison.candidates import Candidate
from lcopa_bayes.comparison.containment import Check
from lcopa_bayes.comparison.judgement import judged
from lcopa_bayes.core.errors import InputError, refuse_if
from lcopa_bayes.core.files import writable_folder
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.core.progress import Progress
from lcopa_bayes.inference.assembly import problem_of


def compare(
    candidates: Sequence[Candidate],
    *,
    jobs: int = 1,
    folder: Path | None = None,
    resume: bool = False,
    quick: bool = False,
    quiet: bool = True,
) -> dict[str, Any]:
    """Fit every candidate, score it, and say which is warranted; plain values as `compare.json` holds them.

    A candidate that contains another is held against it, and sampled again where it has missed a mode that
    the smaller one has found (`containment`).

    Candidates are fitted in `jobs` processes; what they give is the same. With `folder` each has a folder
    of its own under `candidates/`, and `resume` goes on from what is there. InputError for fewer than two
    candidates, for candidates of different records, and when a candidate does not fit its records; then
    nothing is fitted.
    """
    problems = _problems(candidates)
    refuse_if(problems)
    place = None if folder is None else writable_folder(folder) / "candidates"
    tasks = []
    for one in candidates:
        own = None if place is None else writable_folder(place / folder_name(one.name))
        tasks.append(contender(one, own, quick=quick, resume=resume))
    cards: dict[str, Mapping[str, Any]] = {}
    with Progress(total=len(tasks), unit="candidate", quiet=quiet, desc="comparing") as bar:
        for values in _performed(tasks, jobs):
            cards[str(values["name"])] = values
            bar.update()
        bar.set_description("holding against contained models")
        for wave in _by_size(tasks, cards):
            checks = [
                Check(
                    task,
                    cards[task.candidate.name],
                    tuple(
                        (other.candidate, cards[other.candidate.name])
                        for other in tasks
                        if _size(cards, other) < _size(cards, task)
                    ),
                )
                for task in wave
            ]
            for values in _performed(checks, jobs):
                cards[str(values["name"])] = values
    return judged([cards[one.name] for one in candidates], candidates[0].study)


def _size(cards: Mapping[str, Mapping[str, Any]], task: Contender) -> int:
    return int(cards[task.candidate.name]["parameters"])


def _by_size(tasks: Sequence[Contender], cards: Mapping[str, Mapping[str, Any]]) -> Iterator[list[Contender]]:
    """Candidates of equally many parameters together, the smallest first: what one has found, the richer
    ones are held against."""
    for size in sorted({_size(cards, task) for task in tasks}):
        yield [task for task in tasks if _size(cards, task) == size]


def folder_name(name: str) -> str:
    """Folder of a candidate."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name)


def _problems(candidates: Sequence[Candidate]) -> list[str]:
    problems: list[str] = []
    if len(candidates) < 2:
        problems.append(
            f"a comparison needs two candidates or more; got {len(candidates)}: name others under "
            "[compare] pick, [[candidates]] or --pick"
        )
    names = [one.name for one in candidates]
    folders = [folder_name(name) for name in names]
    problems += [
        f"candidates {', '.join(repr(n) for n, f in zip(names, folders, strict=True) if f == twice)} would "
        "share a folder; give them other names"
        for twice in sorted({f for f in folders if folders.count(f) > 1})
    ]
    for one in candidates[1:]:
        if not _same_data(candidates[0], one):
            problems.append(
                f"candidates {candidates[0].name!r} and {one.name!r} have different data; evidence and "
                "predictions compare models of the same records only"
            )
    for one in candidates if not problems else ():
        try:
            problem_of(one.study)
        except InputError as error:
            problems += [f"candidate {one.name!r}: {problem}" for problem in error.problems]
    return problems


def _same_data(one: Candidate, other: Candidate) -> bool:
    """Whether two candidates are fitted to and held against the same samples."""

    def held(candidate: Candidate) -> list[tuple[str, bytes, bytes, bytes]]:
        study = candidate.study
        return [
            (record.name, record.time.tobytes(), record.drive.tobytes(), record.response.tobytes())
            for record in (*study.fit, *study.held_out)
        ]

    return held(one) == held(other) and len(one.study.fit) == len(other.study.fit)


def _performed(tasks: Sequence[Contender | Check], jobs: int) -> Iterator[Mapping[str, Any]]:
    """Cards as they are finished, the largest model begun first."""
    ranked = sorted(tasks, key=lambda task: -problem_of(task.candidate.study).posterior.dimension)
    with workers(None, jobs=min(jobs, len(tasks))) as crew:
        yield from crew.finished(_perform, ranked)


def _perform(_: None, task: Contender | Check) -> Mapping[str, Any]:
    return task()
