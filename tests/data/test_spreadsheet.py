"""Tables as people save them: any notation is read back, and what is ambiguous is asked for."""

from __future__ import annotations

import csv
import datetime
import io
import re
import time
import tracemalloc
from contextlib import suppress
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from openpyxl import Workbook

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.conversion import Mapped, axis_of, convert, resolved
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.spreadsheet import decimal_sign, numbers, read_spreadsheet

N = 60
TIME = 0.5 * np.arange(N)
DRIVE = np.where(TIME < 5, 0.0, np.where(TIME < 20, 40.25, 15.5))
RESPONSE = np.round(21 + 0.35 * np.convolve(DRIVE, np.exp(-np.arange(N) / 9) / 9)[:N], 4)
START = datetime.datetime(2026, 3, 14, 23, 59, 50)


def table(
    path: Path,
    header: tuple[str, ...] = ("Time [s]", "Heater [%]", "T1 (°C)"),
    *,
    separator: str = ",",
    decimal: str = ".",
    encoding: str = "utf-8",
    above: str = "",
    times: list[str] | None = None,
) -> Path:
    def text(value: float) -> str:
        return repr(float(value)).replace(".", decimal)

    buffer = io.StringIO()
    buffer.write(above)
    writer = csv.writer(buffer, delimiter=separator, lineterminator="\n")
    writer.writerow(header)
    for k in range(N):
        writer.writerow([times[k] if times else text(TIME[k]), text(DRIVE[k]), text(RESPONSE[k])])
    path.write_text(buffer.getvalue(), encoding=encoding)
    return path


def read(path: Path, **stated: str | tuple[str, ...]) -> Record:
    return convert([read_spreadsheet(path)], Mapped(**stated))[0][0]  # type: ignore[arg-type]


NOTATIONS = st.tuples(
    st.sampled_from([(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), ("|", ",")]),
    st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
    st.sampled_from(["", "Oven 3, measured by Müller\n\n", "# a\n# b\n"]),
    st.sampled_from(
        [
            None,
            "%Y-%m-%d %H:%M:%S.%f",
            "%Y-%m-%dT%H:%M:%S.%f",
            "%d.%m.%Y %H:%M:%S,%f",
            "%m/%d/%Y %I:%M:%S.%f %p",
            "%H:%M:%S.%f",
        ]
    ),
)


@given(notation=NOTATIONS)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_written_in_any_notation_is_read_back(notation, tmp_path):
    (separator, decimal), encoding, above, form = notation
    stamps = None
    if form:
        stamps = [(START + datetime.timedelta(seconds=float(t))).strftime(form) for t in TIME]
        if separator == ",":
            stamps = [stamp.replace(",", ".") for stamp in stamps]
    header = ("Clock" if form else "Time [s]", "Heater [%]", "T1 (°C)")
    record = read(
        table(
            tmp_path / "x.csv",
            header,
            separator=separator,
            decimal=decimal,
            encoding=encoding,
            above=above,
            times=stamps,
        )
    )
    assert_allclose(record.time, TIME, atol=1e-9)
    assert_array_equal(record.drive[:, 0], DRIVE)
    assert_array_equal(record.response[:, 0], RESPONSE)
    assert (record.drive_axes, record.response_axes) == ((Axis("Heater", "%"),), (Axis("T1", "°C"),))


def workbook(path: Path, sheet: str = "data") -> Path:
    book = Workbook()
    book.active.title = "notes"
    page = book.create_sheet(sheet)
    page.append(["Zeit", "Heater [%]", "T1"])
    page.append(["", "", "[°C]"])
    for k in range(N):
        page.append([START + datetime.timedelta(seconds=float(TIME[k])), float(DRIVE[k]), float(RESPONSE[k])])
    book.save(path)
    return path


def test_a_workbook_is_read_from_the_sheet_that_holds_a_table(tmp_path):
    path = workbook(tmp_path / "x.xlsx")
    record = read(path)
    assert_allclose(record.time, TIME, atol=1e-6)
    assert_array_equal(record.response[:, 0], RESPONSE)
    assert record.response_axes == (Axis("T1", "°C"),)
    with pytest.raises(InputError, match="has no sheet 'dat'; did you mean 'data'"):
        read_spreadsheet(path, sheet="dat")


REMARKS = [
    "Oven test;\n2026-05-01 12:00;\n",
    "Operator;J. Doe\nDate;01.05.2026\nChannels;2\n\n",
    "Interval;0.5\n",
    "Operator;J. Doe\nSerial;17\n",
]


@pytest.mark.parametrize("remarks", REMARKS)
@pytest.mark.parametrize("header", ["Time [s];Heater [%];T1", "t [s];u;y"])
def test_remarks_above_a_header_may_look_like_data(remarks, header, tmp_path):
    table(tmp_path / "x.csv", tuple(header.split(";")), separator=";", above=remarks)
    assert read_spreadsheet(tmp_path / "x.csv").names == header.split(";")
    assert_array_equal(read(tmp_path / "x.csv").time, TIME)


def test_a_line_of_text_within_the_data_is_no_header(tmp_path):
    (tmp_path / "x.csv").write_text("Time [s],u,y\n0,0,1\nstop,stop,stop\n2,1,4\n3,1,5")
    with pytest.raises(InputError, match="line 3, column 'Time \\[s\\]': 'stop' is not a number of time"):
        read(tmp_path / "x.csv")
    (tmp_path / "y.csv").write_text("0,0,1\nstop,stop,stop\n2,1,4\n3,1,5")
    with pytest.raises(InputError, match="has no header"):
        read(tmp_path / "y.csv")


def test_the_sheet_that_is_read_is_named_and_remarks_are_no_table(tmp_path):
    book = Workbook()
    book.active.append(["Operator", "J. Doe"])
    book.active.append(["Rate", 2])
    for name, cell in (("run 1", 5.0), ("run 2", "oops")):
        page = book.create_sheet(name)
        page.append(["t [s]", "u", "y"])
        for row in ([0, 0, 1], [1, 1, 2], [2, 1, cell]):
            page.append(row)
    book.save(tmp_path / "x.xlsx")
    _, notes = convert([read_spreadsheet(tmp_path / "x.xlsx")], Mapped())
    assert notes[0] == "x.xlsx: sheet 'run 1' is read; --sheet names another."
    with pytest.raises(InputError, match=r"x.xlsx, sheet 'run 2', row 4, column 'y': 'oops' is not a number"):
        convert([read_spreadsheet(tmp_path / "x.xlsx", sheet="run 2")], Mapped())


def test_a_table_without_a_drive_is_not_told_to_name_its_response(tmp_path):
    (tmp_path / "x.csv").write_text("Time [s],u,y\n0,1,1\n1,1,2\n2,1,4\n3,1,5")
    with pytest.raises(InputError, match="only 'y' holds numbers that change; a record needs a drive that"):
        read(tmp_path / "x.csv")
    (tmp_path / "y.csv").write_text("Time [s],{u,y{0}\n0,1,1\n1,1,1\n2,1,1\n3,1,1")
    with pytest.raises(InputError, match="no other column holds numbers that change"):
        read(tmp_path / "y.csv")
    (tmp_path / "z.csv").write_text("Time [s],y,{b\n0,1,3\n1,3,1\n2,2,2\n3,5,7")
    with pytest.raises(InputError, match=r"name one with --drive, one of 'y', '\{b'"):
        read(tmp_path / "z.csv")


def test_a_formula_without_a_stored_result_is_named_by_its_cell(tmp_path):
    book = Workbook()
    book.active.append(["t [s]", "u", "y"])
    for k in range(5):
        book.active.append([k, 1.0, f"=A{k + 2}*2"])
    book.save(tmp_path / "x.xlsx")
    with pytest.raises(InputError, match="cell C2: the formula has no stored result"):
        read_spreadsheet(tmp_path / "x.xlsx")


def test_formulas_with_results_are_read(tmp_path):
    """What a spreadsheet program has saved: the formula and its result."""
    book = Workbook()
    book.active.append(["t [s]", "u", "y"])
    for k in range(5):
        book.active.append([k, 1.0, 900.0 + k])
    book.save(tmp_path / "x.xlsx")
    with ZipFile(tmp_path / "x.xlsx") as saved, ZipFile(tmp_path / "y.xlsx", "w") as other:
        for name in saved.namelist():
            content = re.sub(rb"<v>(90\d)</v>", rb"<f>800+100</f><v>\1</v>", saved.read(name))
            other.writestr(name, content)
    assert list(read_spreadsheet(tmp_path / "y.xlsx").columns[2]) == [f"90{k}" for k in range(5)]


def test_a_workbook_is_read_row_by_row(tmp_path):
    """Not held as cells, which take 3 kB a row; nor cut off where the stated dimension is wrong, and a column
    without a name stays."""
    count, book = 4_000, Workbook()
    book.active.append(["t [s]", "u"])
    for k in range(count):
        book.active.append([k, k % 2, 0.5 * k])
    book.save(tmp_path / "x.xlsx")
    with ZipFile(tmp_path / "x.xlsx") as saved, ZipFile(tmp_path / "y.xlsx", "w") as other:
        for name in saved.namelist():
            other.writestr(name, saved.read(name).replace(b'ref="A1:C4001"', b'ref="A1"'))
    read_spreadsheet(tmp_path / "x.xlsx")  # the library is loaded
    tracemalloc.start()
    table = read_spreadsheet(tmp_path / "y.xlsx")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert table.names == ["t [s]", "u", "column 3"]
    assert [len(one) for one in table.columns] == [count] * 3
    assert table.columns[2][-1] == "1999.5"
    assert peak < 1_500 * count


def test_date_and_time_of_day_may_stand_in_two_columns(tmp_path):
    rows = ["Date;Time;Heater [%];T1 [°C]"]
    for k in range(N):
        at = START + datetime.timedelta(seconds=float(TIME[k]))
        rows.append(f"{at:%d.%m.%Y};{at:%H:%M:%S.%f};{DRIVE[k]};{RESPONSE[k]}")
    (tmp_path / "x.txt").write_text("\n".join(rows))
    assert_allclose(read(tmp_path / "x.txt").time, TIME, atol=1e-9)


@pytest.mark.parametrize(
    ("header", "axis"),
    [
        ("Heater [%]", Axis("Heater", "%")),
        ("T1 (°C)", Axis("T1", "°C")),
        ("Druck in bar", Axis("Druck", "bar")),
        ("force / N", Axis("force", "N")),
        ("plain name", Axis("plain_name", "-")),
        ("valve %", Axis("valve", "%")),
        ("T1 °C", Axis("T1", "°C")),
        ("angle [deg_C]", Axis("angle", "degC")),
        ("1", Axis("1", "-")),
    ],
)
def test_headers_give_name_and_unit(header, axis):
    assert axis_of(header) == axis


def test_columns_are_meant_by_header_by_name_and_by_number():
    names = ["Time [s]", "Heater [%]", "heater 2 [%]"]
    assert [resolved(one, names) for one in ("Heater [%]", "heater 2", "1", "cooler")] == [
        "Heater [%]", "heater 2 [%]", "Time [s]", None,
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("cells", "sign"),
    [
        (["1,5", "2"], ","),
        (["1.5", "2"], "."),
        (["1.234,5"], ","),
        (["1,234.5"], "."),
        (["1,234,567"], "."),
        (["0,123"], ","),
        (["1,234"], ""),
    ],
)
def test_the_decimal_sign_is_recognised_or_asked_for(cells, sign, tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("a;b\n" + "\n".join(f"1;{cell}" for cell in cells))
    problems: list[str] = []
    known = decimal_sign(read_spreadsheet(path), problems)
    assert (known if not problems else "") == sign


def test_a_drive_that_acted_until_its_row_stands_a_row_earlier(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("time_s,drive_u_V,response_y_V\n0,0,1\n1,2,3\n2,5,4\n3,5,4\n")
    assert read(path).drive[:, 0].tolist() == [0, 2, 5, 5]
    assert read(path, until=True).drive[:, 0].tolist() == [2, 5, 5, 5]


def test_numbers_in_foreign_notation():
    assert_array_equal(
        numbers(["1.234,5", "\u22122", "3 000", "x", "", "5%"], ","), [1234.5, -2, 3000, np.nan, np.nan, 5]
    )
    assert_array_equal(numbers(["1,234.5", "1e-3", "inf", "nan"], "."), [1234.5, 1e-3, np.nan, np.nan])
    assert_array_equal(
        numbers(["2.5", "1.234.567", "1.23.456", ".5"], ","), [np.nan, 1234567, 123456, np.nan]
    )
    assert_array_equal(numbers(["2,5", "12,34,567", ".5", "+7."], "."), [np.nan, 1234567, 0.5, 7])


def test_roles_follow_words_then_data_and_may_be_stated(tmp_path):
    path = table(tmp_path / "x.csv", ("t [ms]", "channel 1", "channel 2"))
    (record,), notes = convert([read_spreadsheet(path)], Mapped())
    assert [axis.name for axis in record.drive_axes] == ["channel_1"]
    assert any("constant but for few jumps" in note for note in notes)
    swapped = read(path, drives=("force [N]=channel 2",), responses=("2",))
    assert swapped.drive_axes == (Axis("force", "N"),)
    assert_array_equal(swapped.drive[:, 0], RESPONSE)
    assert swapped.time_unit == "ms"


@pytest.mark.parametrize("names", [("in", "out"), ("Eingang", "Ausgang"), ("u1", "y1")])
def test_usual_names_of_a_drive_that_never_rests_are_known(names, tmp_path):
    rng = np.random.default_rng(2)
    rows = [f"{t},{rng.normal():.4f},{rng.normal():.4f}" for t in range(20)]
    path = tmp_path / "x.csv"
    path.write_text("\n".join([f"time_s,{names[0]} [V],{names[1]} [V]", *rows]))
    record = read(path)
    assert [axis.name for axis in (*record.drive_axes, *record.response_axes)] == list(names)


def test_a_quantised_response_is_no_drive(tmp_path):
    rng = np.random.default_rng(1)
    slow = np.round(np.cumsum(rng.random(400) < 0.05) * 0.1, 1)
    rows = [f"{k},{float(k > 20)},{slow[k]}" for k in range(400)]
    (tmp_path / "x.csv").write_text("t [s],a,b\n" + "\n".join(rows))
    record = read(tmp_path / "x.csv")
    assert [axis.name for axis in (*record.drive_axes, *record.response_axes)] == ["a", "b"]


def test_a_drive_is_constant_in_a_dark_record_and_logged_only_when_it_changes(tmp_path):
    table(tmp_path / "on.csv")
    rows = [f"{TIME[k]},{'0.0' if k == 0 else ''},{RESPONSE[k]}" for k in range(N)]
    (tmp_path / "dark.csv").write_text("Time [s],Heater [%],T1 (°C)\n" + "\n".join(rows))
    tables = [read_spreadsheet(tmp_path / name) for name in ("on.csv", "dark.csv")]
    (_, dark), notes = convert(tables, Mapped())
    assert_array_equal(dark.drive, np.zeros((N, 1)))
    assert any("holds the value above" in note for note in notes)


BROKEN = {
    "Time [s],Clock [s],u,y\n1,1,0,0\n2,2,1,1\n3,3,1,2": "several columns may hold the time",
    "a,u,y\n3,0,0\n2,1,1\n3,1,0": "no column increases from row to row",
    "Time,u,y\n1,0,0\n2,1,1\n3,1,2": "has no unit; state it with --time-unit",
    "Time [fortnight],u,y\n1,0,0\n2,1,1\n3,1,2": "'fortnight', which is not known",
    "Time [s],u [%],u (%),y\n0,0,1,1\n1,1,2,2\n2,1,1,4": "would both be the drive 'u'",
    "Time [s],u,y\n0,1,0,2,0,3\n0,2,0,2,0,3\n0,3,0,2,0,3": r"decimals are written with commas.*in all 3 rows",
    "Time [s];u;y\n0;0;1,5\n1;1;2.5\n2;1;3,5": "line 3, column 'y': '2.5' is not a number of y",
    "Time [s],y\n0,1.2\n1,1.3\n2,1.1\n3,1.2\n4,1.9": "no column is recognised as a drive",
    "Time [s],u,y\n0,0,1\n1,1,2\n1,1,3": "does not come after",
    "Time [s],u,y\n0,0,1\n1,1,2\n2,1,oops\n3,1,4": "line 4, column 'y': 'oops' is not a number of y",
    "Time [s],u,y\n0,,1\n1,1,2\n2,0,3\n3,1,4": "first row has no value of the drive 'u'",
    "no table at all": "holds no table",
    "1,2,3\n2,3,4": "has no header",
    "Time,u,y\n2026-01-02 10:00,0,1\n03.01.2026 10:00,1,2\n2026-01-04 10:00,1,4": "write all times alike",
    "Time,u,y\n01/02/2026 10:00,0,1\n03/02/2026 10:00,1,2\n04/02/2026 10:00,1,4": "day or the month first",
}


@pytest.mark.parametrize(("text", "message"), BROKEN.items(), ids=BROKEN.values())
def test_what_is_ambiguous_is_asked_for(text, message, tmp_path):
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read(tmp_path / "x.csv")


def test_headers_alike_are_numbered_before_their_unit_and_may_be_named(tmp_path):
    (tmp_path / "x.csv").write_text("Time [s],u,Temp [C],Temp [C]\n0,0,1,5\n1,1,2,6.5\n2,1,4,7")
    assert read(tmp_path / "x.csv").response_axes == (Axis("Temp", "C"), Axis("Temp_2", "C"))
    (tmp_path / "y.csv").write_text("Time [s],u [%],u (%),y\n0,0,1,1\n1,1,2,2\n2,1,1,4")
    named = read(tmp_path / "y.csv", drives=("u [%]", "v=u (%)"))
    assert named.drive_axes == (Axis("u", "%"), Axis("v", "%"))
    assert_array_equal(named.drive[:, 1], [1, 2, 1])
    with pytest.raises(InputError, match="would both be the drive 'u'"):
        read(tmp_path / "y.csv", drives=("u [%]", "u (%)"))


def test_a_sheet_that_is_absent_or_empty_is_named_with_the_others(tmp_path):
    workbook = Workbook()
    workbook.active.title = "Data"
    workbook.create_sheet("Notes")
    workbook.save(tmp_path / "x.xlsx")
    with pytest.raises(InputError, match="has no sheet 'Dato'; did you mean 'Data'"):
        read_spreadsheet(tmp_path / "x.xlsx", sheet="Dato")
    with pytest.raises(InputError, match=r"sheet 'Notes': holds no table.*the other sheets are 'Data'"):
        read_spreadsheet(tmp_path / "x.xlsx", sheet="Notes")


def test_what_is_asked_for_can_be_stated(tmp_path):
    days = "Time,u,y\n01/02/2026 10:00:00,0,1\n03/02/2026 10:00:00,1,2\n04/02/2026 10:00:00,1,4"
    (tmp_path / "x.csv").write_text(days)
    got = [
        read(tmp_path / "x.csv", time_format=f"{form} %H:%M:%S.%f").time[1]
        for form in ("%d/%m/%Y", "%m/%d/%Y")
    ]
    assert_allclose(got, [2 * 86400, 59 * 86400])
    (tmp_path / "y.csv").write_text("Time;u;y\n1;0;1,000\n2;1;2,000\n3;1;3,000")
    with pytest.raises(InputError, match="--decimal"):
        read(tmp_path / "y.csv", time_unit="h")
    for sign, value in ((",", 2.0), (".", 2000.0)):
        record = read(tmp_path / "y.csv", time_unit="h", decimal=sign)
        assert (record.response[1, 0], record.time_unit) == (value, "h")


@pytest.mark.parametrize("content", [b"\x00\x01\x02", b"", b"PK\x03\x04rubbish"])
def test_what_is_no_table_is_refused(content, tmp_path):
    for suffix in (".csv", ".xlsx"):
        (tmp_path / f"x{suffix}").write_bytes(content)
        with pytest.raises(InputError, match=f"x{suffix}: "):
            read_spreadsheet(tmp_path / f"x{suffix}")
    with pytest.raises(InputError, match=r"no such file; did you mean 'x.csv'"):
        read_spreadsheet(tmp_path / "xx.csv")


CELLS = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True).map(str),
    st.integers(-1000, 1000).map(str),
    st.sampled_from(
        ["", "NaN", "1,5", "1.234,5", "2026-01-02", "03.04.2026 10:00", "10:00:01", "-", "#REF!", "x"]
    ),
    st.text(max_size=6),
)


@given(
    header=st.lists(
        st.one_of(st.text(max_size=8), st.sampled_from(["t [s]", "u", "y", "Time", "u"])), max_size=5
    ),
    rows=st.lists(st.lists(CELLS, max_size=5), max_size=8),
    separator=st.sampled_from(",;\t|"),
    content=st.none() | st.binary(max_size=200),
)
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_table_is_read_or_refused_in_words(header, rows, separator, content, tmp_path):
    path = tmp_path / "x.csv"
    if content is None:
        text = "\n".join(separator.join(cells) for cells in [header, *rows])
        path.write_text(text, encoding="utf-8", errors="replace")
    else:
        path.write_bytes(content)
    with suppress(InputError):
        assert read(path).time.size >= 2


@pytest.mark.parametrize(
    "long", ["1.1." * 12_500 + "x", "1" * 50_000, "1:1 " * 12_500, " ".join("a" * 25_000)]
)
def test_cells_of_any_length_are_read_at_once(tmp_path, long):
    """Patterns whose time grows with the square of a cell took minutes over these."""
    path = tmp_path / "a.csv"
    path.write_text(f"Time [s];u ({long};y\n" + "".join(f"{k};{k % 2};{long}\n" for k in range(20)))
    began = time.process_time()
    with pytest.raises(InputError):
        convert([read_spreadsheet(path)], Mapped(drives=("2",), responses=("y",)))
    assert time.process_time() - began < 2.0


def test_numbers_whose_difference_no_float_holds_are_compared_all_the_same(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time_s,drive_x_V,response_x_V\n-1e308,0,1\n1e308,1,2\n-1e308,1,1\n")
    with pytest.raises(InputError, match="line 4, column 'time_s': the time does not come after"):
        convert([read_spreadsheet(path)], Mapped())
