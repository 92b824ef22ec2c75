"""The door for records: what is read exactly, what is refused, and in which words."""

import os
import pickle
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import Axis, Record, in_time_unit, load_record, records_of, save_record

HEADER = "time_ms,drive_x_rad,response_x_rad\n"
GOOD = HEADER + "0,0,\n0.5,1,0.1\n1.5,1,0.2\n"


def written(folder: Path, text: str, name: str = "a.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def problems_of(path: Path) -> tuple[str, ...]:
    with pytest.raises(InputError) as caught:
        load_record(path)
    assert all(str(path) in problem for problem in caught.value.problems)
    return caught.value.problems


def record(**changes: object) -> Record:
    parts = {
        "name": "a",
        "time": [0.0, 0.5, 1.5],
        "drive": [[0.0], [1.0], [1.0]],
        "response": [[np.nan], [0.1], [0.2]],
        "drive_axes": (Axis("x", "rad"),),
        "response_axes": (Axis("x", "rad"),),
        "time_unit": "ms",
    }
    return Record(**{**parts, **changes})  # type: ignore[arg-type]


def test_a_record_is_read_as_written(tmp_path):
    text = "time_ms, drive_left_heater_pct, response_t1_degC, response_t2_degC\n0,0,,\n\n 0.5,1e1,nan,0.1\n"
    got = load_record(written(tmp_path, text, "bench.csv"))
    assert (got.name, got.time_unit) == ("bench", "ms")
    assert got.drive_axes == (Axis("left_heater", "pct"),)
    assert got.response_axes == (Axis("t1", "degC"), Axis("t2", "degC"))
    np.testing.assert_array_equal(got.time, [0, 0.5])
    np.testing.assert_array_equal(got.drive, [[0], [10]])
    np.testing.assert_array_equal(got.response, [[np.nan, np.nan], [np.nan, 0.1]])


def test_byte_order_mark_and_carriage_returns_are_no_content(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    np.testing.assert_array_equal(load_record(path).time, [0, 0.5, 1.5])


def test_a_quiet_hold_is_a_record(tmp_path):
    assert (load_record(written(tmp_path, HEADER + "0,1,0\n1,1,0\n")).drive == 1).all()


@pytest.mark.parametrize(
    ("column", "unit", "time"), [("s", "ms", 1500.0), ("us", "ms", 0.0015), ("us", "s", 1.5e-6)]
)
def test_times_are_converted(tmp_path, column, unit, time):
    path = written(tmp_path, GOOD.replace("time_ms", f"time_{column}"))
    got = load_record(path, unit)
    assert (got.time[2], got.time_unit) == (time, unit)
    assert load_record(path).time_unit == column


BAD_CELLS = [
    (3, "drive_x_rad", "0,0,0\n1,abc,0\n", ["'abc' is not a finite number"]),
    (3, "drive_x_rad", "0,0,0\n1,,0\n", ["the cell is empty"]),
    (3, "drive_x_rad", "0,0,0\n1,nan,0\n", ["'nan' is not a finite number"]),
    (3, "drive_x_rad", "0,0,0\n1,1_0,0\n", ["'1_0' is not a finite number"]),
    (3, "drive_x_rad", '0,0,0\n1,"1,5",0\n', ["'1,5' is not a finite number"]),
    (2, "time_ms", ",0,0\n1,1,0\n", ["the cell is empty"]),
    (2, "time_ms", "-inf,0,0\n1,1,0\n", ["'-inf' is not a finite number"]),
    (4, "time_ms", "0,0,0\n2,1,0\n2,1,0\n", ["2.0 does not come after", "2.0"]),
    (4, "time_ms", "0,0,0\n2,1,0\n1.5,1,0\n", ["1.5 does not come after", "2.0"]),
    (3, "response_x_rad", "0,0,0\n1,1,inf\n", ["'inf' is not a finite number", "missing sample"]),
    (3, "response_x_rad", "0,0,0\n1,1,1e999\n", ["'1e999' is not a finite number"]),
    (3, "response_x_rad", "0,0,0\n1,1,n/a\n", ["'n/a' is not a finite number"]),
]


@pytest.mark.parametrize(("line", "column", "rows", "words"), BAD_CELLS)
def test_a_bad_cell_is_named_by_line_and_column(tmp_path, line, column, rows, words):
    (problem,) = problems_of(written(tmp_path, HEADER + rows))
    for part in (f"line {line},", repr(column), *words):
        assert part in problem


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("time_ms,drve_x_rad,response_x_rad", ["'drve_x_rad'", "did you mean 'drive'?", "no drive column"]),
        ("time_ms,drive_x_rad,response_x", ["'response_x'", "response_<axis>_<unit>"]),
        ("time_ms,drive_rad,response_x_rad", ["'drive_rad'", "drive_<axis>_<unit>"]),
        ("time_m,drive_x_rad,response_x_rad", ["'time_m'", "did you mean 'ms'?"]),
        ("time,drive_x_rad,response_x_rad", ["'time'", "known: h, min, ms, ns, s, us"]),
        ("drive_y_rad,drive_x_rad,response_x_rad", ["has no time column"]),
        ("time_ms,response_y_rad,response_x_rad", ["has no drive column"]),
        ("time_ms,drive_x_rad,drive_y_rad", ["has no response column"]),
        ("time_ms,drive_x_rad,response_x_rad,time_s", ["'time_s'", "keep one"]),
        ("time_ms,drive_x_rad,response_x_rad,drive_x_rad", ["column 4 of 4", "'drive_x_rad'", "keep one"]),
        ("time_ms,drive_x_rad,response_x_rad,drive_x_deg", ["'drive_x_deg'", "'x'", "keep one"]),
        ("time_ms,drive_x_rad,response_x_rad,", ["column 4 of 4"]),
        ("time_ms,drive_x\ty_rad,response_x_rad", ["column 2 of 3"]),
    ],
)
def test_a_bad_header_is_named_by_column(tmp_path, header, words):
    row = ",0" * header.count(",")
    reported = "\n".join(problems_of(written(tmp_path, f"{header}\n0{row}\n1{row}\n")))
    for part in words:
        assert part in reported


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        (HEADER, "has 0 row(s)"),
        (HEADER + "0,0,0\n", "has 1 row(s)"),
        (HEADER + "0,0,\n1,1,\n", "no response column holds a sample"),
        (HEADER + "0,0,0\n1,1\n", "line 3: has 2 cell(s) where the header has 3"),
        (HEADER + "0,0,0\n1,1,0,0\n", "line 3: has 4 cell(s) where the header has 3"),
        (GOOD.replace(",", ";"), "not separated by commas"),
        (HEADER + '0,0,0\n1,"1,0\n', "is not comma-separated text"),
    ],
)
def test_a_bad_table_is_one_problem(tmp_path, text, words):
    (problem,) = problems_of(written(tmp_path, text))
    assert words in problem


def test_all_problems_come_at_once_and_are_capped_per_column(tmp_path):
    rows = "".join(f"{k},bad,0\n" for k in range(9)) + "8,1,inf\n9,1\n"
    reported = problems_of(written(tmp_path, HEADER + rows))
    assert sum("'bad'" in problem for problem in reported) == 5
    for part in (
        "and 4 more",
        "line 11, column 'response_x_rad'",
        "line 11, column 'time_ms'",
        "line 12: has 2",
    ):
        assert sum(part in problem for problem in reported) == 1
    assert len(reported) == 9


def test_a_cell_that_is_no_text_is_refused_with_its_row():
    rows = {"time_ms": [0.0, 1.0], "drive_x_V": [0, 1], "response_x_rad": ["0.1", "\udc00"]}
    with pytest.raises(InputError, match="row 2, column 'response_x_rad': '\\?' is not a finite number"):
        records_of(pd.DataFrame(rows, dtype=object))


@pytest.mark.parametrize("notes", [b"{}", b'{"columns": [{}], "index_columns": []}', b"[]"])
def test_damaged_notes_of_pandas_are_refused_in_words(tmp_path, notes):
    table = pa.table({"time_ms": [0.0, 1.0], "drive_x_V": [0.0, 1.0], "response_x_rad": [0.0, 1.0]})
    pq.write_table(table.replace_schema_metadata({b"pandas": notes}), tmp_path / "a.parquet")
    with pytest.raises(InputError, match="is not sound Parquet"):
        load_record(tmp_path / "a.parquet")


def test_files_that_cannot_be_read(tmp_path):
    written(tmp_path, GOOD, "x_on.csv")
    assert "cannot be read" in problems_of(tmp_path / f"{'x' * 300}.csv")[0]
    assert "no such file; did you mean 'x_on.csv'?" in problems_of(tmp_path / "x_onn.csv")[0]
    assert "is not a record" in problems_of(tmp_path)[0]
    assert "is not a record" in problems_of(written(tmp_path, GOOD, "a.txt"))[0]
    (tmp_path / "b.csv").write_bytes(GOOD.encode("utf-16"))
    assert "is not UTF-8" in problems_of(tmp_path / "b.csv")[0]
    assert "cannot be read" in problems_of(written(tmp_path, GOOD, "c.parquet"))[0]
    with pytest.raises(InputError, match="unknown time unit 'mss'; did you mean 'ms'"):
        load_record(tmp_path / "x_on.csv", "mss")


def test_times_that_collapse_on_conversion_are_refused(tmp_path):
    path = written(tmp_path, "time_us,drive_x_V,response_x_V\n4.9e-321,0,0\n4.94e-321,1,0\n")
    load_record(path, "us")
    with pytest.raises(InputError, match=r"record 'a': times must increase strictly \[s\]"):
        load_record(path, "s")


def test_parquet_problems_name_the_row(tmp_path):
    path = tmp_path / "a.parquet"
    columns = {"time_ms": [0, 1, 1], "drive_x_rad": [0.0, np.nan, 1.0], "response_x_rad": ["0", None, "high"]}
    pd.DataFrame(columns).to_parquet(path)
    reported = problems_of(path)
    assert len(reported) == 3
    assert any("row 2, column 'drive_x_rad': the cell is empty" in problem for problem in reported)
    assert any("row 3, column 'response_x_rad': 'high'" in problem for problem in reported)
    assert any("row 3, column 'time_ms': 1.0 does not come after" in problem for problem in reported)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"time": [0.0, 1.0, 1.0]}, "increase strictly"),
        ({"time": [0.0, 1.0, np.inf]}, "`time` must be finite"),
        ({"drive": [[0.0], [np.nan], [1.0]]}, "`drive` must be finite"),
        ({"drive": [0.0, 1.0, 1.0]}, "`drive` must have 2"),
        ({"response": [[np.nan]] * 3}, "response samples"),
        ({"drive": [[0.0, 0.0]] * 3}, "need"),
        ({"drive_axes": ()}, "distinct names"),
        ({"drive_axes": (Axis("x", "V"), Axis("x", "rad")), "drive": [[0.0, 0.0]] * 3}, "distinct names"),
        ({"time_unit": "day"}, "time unit 'day'"),
        ({"time": [0.0], "drive": [[0.0]], "response": [[0.0]]}, "two or more rows"),
    ],
)
def test_a_record_checks_itself(changes, words):
    with pytest.raises(InputError, match="record 'a'") as caught:
        record(**changes)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("name", "unit"), [("", "rad"), ("x", ""), ("x", "m_s"), (" x", "rad"), ("x\n", "rad")]
)
def test_an_axis_has_words_that_a_column_can_hold(name, unit):
    with pytest.raises(InputError, match="axis"):
        Axis(name, unit)


def test_records_are_locked_copies_also_in_another_process():
    time = np.array([0.0, 0.5, 1.5])
    made = record(time=time)
    time[0] = -1
    for one in (made, pickle.loads(pickle.dumps(made))):
        assert one.time[0] == 0
        for array in (one.time, one.drive, one.response):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 1


words = st.text("abcxyz019.%/", min_size=1, max_size=4)
axis_names = st.lists(
    words.flatmap(lambda w: st.sampled_from([w, f"{w}_{w}"])), min_size=1, max_size=3, unique=True
)
numbers = st.floats(-1e12, 1e12)


@st.composite
def records(draw):
    n = draw(st.integers(2, 8))
    start, steps = draw(st.floats(-1e3, 1e3)), draw(arrays(float, n, elements=st.floats(1e-3, 1e3)))
    axes = [tuple(Axis(name, draw(words)) for name in draw(axis_names)) for _ in range(2)]
    drive = draw(arrays(float, (n, len(axes[0])), elements=numbers))
    response = draw(arrays(float, (n, len(axes[1])), elements=numbers | st.just(np.nan)))
    response[-1, 0] = draw(numbers)
    unit = draw(st.sampled_from(["s", "ms", "us"]))
    return Record("kept", start + np.cumsum(steps), drive, response, *axes, unit)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@given(one=records(), unit=st.sampled_from(["s", "ms", "us"]))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_saving_and_loading_is_exact(tmp_path, suffix, one, unit):
    path = tmp_path / f"kept{suffix}"
    save_record(one, path)
    same = load_record(path, one.time_unit)
    assert (same.name, same.drive_axes, same.response_axes) == (one.name, one.drive_axes, one.response_axes)
    for key in ("time", "drive", "response"):
        np.testing.assert_array_equal(getattr(same, key), getattr(one, key))
    other = load_record(path, unit)
    back = in_time_unit(other.time, unit, one.time_unit)
    np.testing.assert_allclose(back, one.time, rtol=1e-12, atol=0)
    assert os.listdir(tmp_path) == [path.name]


def test_saving_leaves_the_old_file_when_it_fails(tmp_path, monkeypatch):
    path = written(tmp_path, GOOD)

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(InputError, match="cannot be written"):
        save_record(record(), path)
    assert (os.listdir(tmp_path), path.read_text(encoding="utf-8")) == (["a.csv"], GOOD)
    with pytest.raises(InputError, match="expected a name ending in"):
        save_record(record(), tmp_path / "a.txt")


def test_a_saved_record_reads_as_a_person_would_write_it(tmp_path):
    save_record(record(), tmp_path / "a.csv")
    expected = HEADER + "0.0,0.0,\n0.5,1.0,0.1\n1.5,1.0,0.2\n"
    assert (tmp_path / "a.csv").read_text(encoding="utf-8") == expected
