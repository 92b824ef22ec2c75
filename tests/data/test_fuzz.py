"""Files from anywhere: whatever they hold, a reader gives what it promises or refuses them in its own words.

Files of `corpus`, and tables, workbooks and run folders made here, are cut, spliced and encoded anew.
No other exception and no warning may come of it, and no input may take longer than `MOST`. The environment
variable LCOPA_BAYES_FUZZ is the number of inputs in all, such as 20000 or 1000000; above `REPEATED` they are
new ones in every run. LCOPA_BAYES_FUZZ_SUMMARY is a file for what came of them, as
`studies/robustness/fuzz.py` reports it.
"""

from __future__ import annotations

import io
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small import record, study

from lcopa_bayes.bench.campaignfile import load_plan
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.conversion import Mapped, convert
from lcopa_bayes.data.record import Record, load_record, save_record
from lcopa_bayes.data.spreadsheet import read_spreadsheet
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studyfile import load_candidates, load_study
from lcopa_bayes.results.fit import fit
from lcopa_bayes.verbs.stored import load_result

pytestmark = [
    pytest.mark.filterwarnings("ignore::hypothesis.errors.HypothesisWarning"),  # of long inputs
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),  # xarray leaves files open
]
CORPUS = Path(__file__).parent / "corpus"
REPEATED = 4_000
"""Most inputs that are the same in every run."""
INPUTS = int(os.environ.get("LCOPA_BAYES_FUZZ", REPEATED // 4))
MOST = 5.0
"""Longest time that one input may take [s]."""
SEEN: dict[str, dict[str, float]] = defaultdict(lambda: {"inputs": 0, "refused": 0, "longest": 0.0})
"""Inputs, those refused in words, and the longest time of one [s], by test."""
TEXTS = tuple(path.read_bytes() for path in sorted(CORPUS.glob("*.[ct]sv")))
STUDIES = tuple(path.read_bytes() for path in sorted(CORPUS.glob("*.toml")))
CAMPAIGN = (Path(__file__).parents[2] / "studies" / "paper-step" / "campaign.toml").read_bytes()
ODD = (
    *(
        "nan",
        "-inf",
        "1e999",
        "-1e308",
        "1e-320",
        "1,5",
        "1.234,5",
        "0x1p3",
        "1_000",
        "٣",
        "-0",
        "9" * 400,
        "1" * 5000,
        "1.1." * 5000 + "x",
    ),
    *(
        "",
        " ",
        "\0",
        '"',
        "'",
        ";",
        "\t",
        "=cmd()",
        "@x",
        "+1",
        "\ufeff",
        "\u2028",
        "\r",
        "\ud7ff",
        "é" * 50,
        "{",
        "]",
    ),
    *(
        "[[",
        "true",
        "2024-02-30",
        "2024-01-01T00:00:00Z",
        "time_s",
        "time_ms",
        "drive_x_V",
        "response_x_rad",
        "../a",
    ),
    *(
        "/dev/zero",
        "null",
        "{}",
        "[]",
        '"a"',
        "-1",
        "1e300",
        "100000000000000000000",
        "auto",
        "free",
        "lognorm",
    ),
)
"""What stands in place of a word or a number."""
ENCODINGS = ("utf-16", "utf-16-be", "utf-32", "utf-8-sig", "cp1252", "utf-7", "cp037")
_WORD = re.compile(rb"[^\s,;=\[\]{}\"]+")
Change = Callable[[bytes], bytes]


def cut(share: float) -> Change:
    return lambda data: data[: int(share * len(data))]


def spliced(at: float, some: bytes) -> Change:
    return lambda data: data[: int(at * len(data))] + some + data[int(at * len(data)) :]


def flipped(at: float, bit: int) -> Change:
    def change(data: bytes) -> bytes:
        if not data:
            return data
        k = min(int(at * len(data)), len(data) - 1)
        return data[:k] + bytes([data[k] ^ (1 << bit)]) + data[k + 1 :]

    return change


def replaced(at: float, word: str) -> Change:
    def change(data: bytes) -> bytes:
        words = [*_WORD.finditer(data)]
        if not words:
            return data
        one = words[min(int(at * len(words)), len(words) - 1)]
        return data[: one.start()] + word.encode(errors="surrogatepass") + data[one.end() :]

    return change


def exchanged(old: bytes, new: bytes) -> Change:
    return lambda data: data.replace(old, new)


def encoded(name: str) -> Change:
    return lambda data: data.decode("utf-8", "replace").encode(name, "replace")


def lines(at: float, to: float, *, drop: bool) -> Change:
    """A line moved, or repeated, elsewhere."""

    def change(data: bytes) -> bytes:
        rows = data.splitlines(keepends=True)
        if not rows:
            return data
        k = min(int(at * len(rows)), len(rows) - 1)
        one = rows.pop(k) if drop else rows[k]
        rows.insert(int(to * len(rows)), one)
        return b"".join(rows)

    return change


SHARE = st.floats(0, 1, width=16)
CHANGES = st.one_of(
    st.builds(replaced, SHARE, st.sampled_from(ODD)),
    st.builds(replaced, SHARE, st.sampled_from(ODD)),
    st.builds(cut, SHARE),
    st.builds(spliced, SHARE, st.binary(min_size=1, max_size=8)),
    st.builds(flipped, SHARE, st.integers(0, 7)),
    st.builds(
        exchanged,
        st.sampled_from([b",", b"\n", b".", b"=", b'"']),
        st.sampled_from([b";", b"\r", b"\r\n", b"\t", b",", b"|"]),
    ),
    st.builds(encoded, st.sampled_from(ENCODINGS)),
    st.builds(lines, SHARE, SHARE, drop=st.booleans()),
)


def mutated(*seeds: bytes) -> st.SearchStrategy[bytes]:
    """Bytes close to one of these, or any."""

    def changed(seed: bytes, changes: list[Change]) -> bytes:
        for change in changes:
            seed = change(seed)
        return seed

    near = st.builds(changed, st.sampled_from(seeds), st.lists(CHANGES, max_size=4))
    return st.one_of(near, near, near, near, st.binary(max_size=200))


def many(share: float, *, least: int = 1) -> Callable[[Callable], Callable]:
    """So much of all inputs, and no fewer than `least`."""
    return settings(
        max_examples=max(least, int(share * INPUTS)),
        deadline=None,  # `refused_or` has its own, which a reader that hangs does not outlast
        database=None,
        derandomize=INPUTS <= REPEATED,
        suppress_health_check=list(HealthCheck),
    )


def overdue(*_: object) -> None:
    raise AssertionError(f"not done within {MOST} s")


@contextmanager
def refusing() -> Iterator[None]:
    """Within it a file may be refused in words, at once; a warning is an error."""
    signal.signal(signal.SIGALRM, overdue)
    signal.setitimer(signal.ITIMER_REAL, MOST)
    seen = SEEN[os.environ["PYTEST_CURRENT_TEST"].rpartition("::")[2].split()[0]]
    began = time.perf_counter()
    seen["inputs"] += 1
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    except InputError as refused:
        seen["refused"] += 1
        if not all(problem.strip() for problem in refused.problems or [""]):
            raise AssertionError("refused without a word") from refused
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        seen["longest"] = max(seen["longest"], time.perf_counter() - began)


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@pytest.fixture(scope="module", autouse=True)
def _alarm() -> Iterator[None]:
    before, memory = signal.getsignal(signal.SIGALRM), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    signal.signal(signal.SIGALRM, before)
    if file := os.environ.get("LCOPA_BAYES_FUZZ_SUMMARY"):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        Path(file).write_text(json.dumps({"tests": SEEN, "memory_kB": [memory, peak]}))


def same(a: Record, b: Record) -> bool:
    arrays = ((getattr(a, key), getattr(b, key)) for key in ("time", "drive", "response"))
    return all(np.array_equal(x, y, equal_nan=True) for x, y in arrays) and a.drive_axes == b.drive_axes


@many(0.4)
@given(data=mutated(*TEXTS))
def test_record_files(place, data):
    path = place / "record.csv"
    path.write_bytes(data)
    with refusing():
        read = load_record(path)
        save_record(read, place / "again.csv")
        again = load_record(place / "again.csv")
        assert same(read, again)


@many(0.25)
@given(data=mutated(*TEXTS))
def test_tables_of_any_form(place, data):
    path = place / "table.txt"
    path.write_bytes(data)
    with refusing():
        convert([read_spreadsheet(path)], Mapped())


@many(0.2)
@given(data=mutated(*STUDIES))
def test_study_files(place, data):
    folder = place / "study"
    folder.mkdir(exist_ok=True)
    (folder / "record.csv").write_bytes(TEXTS_BY["record.csv"])
    (folder / "study.toml").write_bytes(data)
    with refusing():
        assert isinstance(load_study(folder), Study)


TEXTS_BY = {path.name: path.read_bytes() for path in CORPUS.glob("*.csv")}


@many(0.065)
@given(data=mutated(*STUDIES))
def test_files_of_candidates(place, data):
    path = place / "candidates.toml"
    path.write_bytes(data)
    with refusing():
        load_candidates(path)


@many(0.05)
@given(data=mutated(CAMPAIGN))
def test_campaign_files(place, data):
    path = place / "campaign.toml"
    path.write_bytes(data)
    with refusing():
        load_plan(path)


def _frames() -> tuple[bytes, ...]:
    frame = pd.DataFrame(
        {"time_s": [0.0, 1.0, 2.0], "drive_x_V": [0, 1, 1], "response_x_rad": [0.1, None, 0.3]}
    )
    texts = frame.astype(str).rename(columns={"time_s": "time_ms"})
    return tuple(each.to_parquet() for each in (frame, texts, frame.assign(response_y_V=[[1], [2], [3]])))


@many(0.02)
@given(data=mutated(*_frames()))
def test_parquet_files(place, data):
    path = place / "record.parquet"
    path.write_bytes(data)
    with refusing():
        load_record(path)


def _workbook() -> bytes:
    image = io.BytesIO()
    rows = [["Zeit [s]", "Heater [%]", "T [C]"], *([k / 2, 40 * (k > 2), 21 + 0.1 * k * k] for k in range(8))]
    pd.DataFrame(rows).to_excel(image, header=False, index=False)
    return image.getvalue()


@many(0.01)
@given(data=mutated(_workbook()))
def test_workbooks(place, data):
    path = place / "table.xlsx"
    path.write_bytes(data)
    with refusing():
        convert([read_spreadsheet(path)], Mapped())


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """The run folder of a fit."""
    tiny = {"target_ess": 50}
    made = fit(study(record(camera=0.8), sampler=tiny, priors={"delay": 0.73, "order_1": 0.8}))
    return made.save(tmp_path_factory.mktemp("run"))


@pytest.mark.parametrize("name", ["fit.json", "provenance.json", "results.json", "posterior.nc"])
def test_run_folders(run, tmp_path, name):
    shutil.copytree(run, tmp_path, dirs_exist_ok=True)

    @many(0.0025, least=20)
    @given(data=mutated((run / name).read_bytes()))
    def read(data):
        (tmp_path / name).write_bytes(data)
        with refusing():
            load_result(tmp_path).to_json()

    read()


@pytest.mark.parametrize("refinement", [0, 17, 10**7, 1.5, True, "2"])
def test_a_fit_on_blocks_without_bound_is_refused(run, tmp_path, refinement):
    """Ten million times narrower ones would take all memory there is."""
    shutil.copytree(run, tmp_path, dirs_exist_ok=True)
    values = json.loads((run / "fit.json").read_text()) | {"refinement": refinement}
    (tmp_path / "fit.json").write_text(json.dumps(values))
    with pytest.raises(InputError, match=r"does not hold a fit \(ValueError: refinement"):
        load_result(tmp_path)


@many(0.005, least=50)
@given(data=st.data())
def test_values_of_a_fit(run, place, data):
    """Entries of the right file that hold something else."""
    folder = place / "values"
    if not folder.exists():
        shutil.copytree(run, folder)
    values = json.loads((run / "fit.json").read_text())
    at, key = values, data.draw(st.sampled_from(sorted(values)))
    while isinstance(at[key], dict | list) and at[key] and data.draw(st.booleans()):
        at = at[key]
        key = data.draw(st.sampled_from(sorted(at) if isinstance(at, dict) else range(len(at))))
    at[key] = data.draw(
        st.sampled_from([None, -1, 1e300, "x", [], {}, [[1]], {"a": 1}, True, "../..", 10**30])
    )
    (folder / "fit.json").write_text(json.dumps(values))
    with refusing():
        load_result(folder)


@pytest.mark.slow
@pytest.mark.skipif("LCOPA_BAYES_FUZZ" in os.environ, reason="the number of inputs is stated")
def test_all_repeated_inputs():
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-m", "not slow", "-p", "no:cacheprovider"]
    environment = os.environ | {"LCOPA_BAYES_FUZZ": str(REPEATED)}
    root = Path(__file__).parents[2]
    done = subprocess.run([*command, __file__], env=environment, cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
