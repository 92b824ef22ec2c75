"""Time stamps: formats as they are stated, zones, elapsed times, and the cells of a workbook."""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from openpyxl import Workbook

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.conversion import Mapped, convert
from lcopa_bayes.data.spreadsheet import read_spreadsheet

START = datetime.datetime(2026, 5, 4, 23, 59, 58)
TIMES = [START + datetime.timedelta(seconds=k) for k in range(6)]


def seconds(path: Path, form: str = "") -> np.ndarray:
    return convert([read_spreadsheet(path)], Mapped(time_format=form))[0][0].time


def stamped(path: Path, stamps: list[str]) -> Path:
    rows = [f"{at};{int(k > 1)};{20 + 0.7 * k}" for k, at in enumerate(stamps)]
    path.write_text("\n".join(["Time;Heater [%];T1", *rows]))
    return path


@pytest.mark.parametrize(
    "form",
    [
        "%d.%m.%Y %H:%M:%S",  # as messages and the help advise
        "%d/%m/%Y %H:%M:%S",
        "%Y-%m-%dT%H:%M:%SZ",
        "%Y-%m-%dT%H:%M:%S.%f",
        "%d.%m.%Y %H:%M:%S,%f",
        "%m/%d/%Y %I:%M:%S%p",
        "%Y%m%d%H%M%S",
        "%d %b %Y %H.%M.%S",
    ],
)
def test_a_stated_format_is_that_of_the_cells_as_they_are_written(form, tmp_path):
    path = stamped(tmp_path / "x.csv", [at.strftime(form) for at in TIMES])
    assert_allclose(seconds(path, form), np.arange(6))


@pytest.mark.parametrize(("form", "said"), [("%Q", "is no format of times"), ("%d.%m.%Y %d", "is no format")])
def test_a_format_that_is_none_is_refused_in_words(form, said, tmp_path):
    path = stamped(tmp_path / "x.csv", [f"{at:%d.%m.%Y %H:%M:%S}" for at in TIMES])
    with pytest.raises(InputError, match=said):
        seconds(path, form)
    with pytest.raises(InputError, match=r"line 2, column 'Time': .* the stated format %d.%m.%Y %H;"):
        seconds(path, "%d.%m.%Y %H")


@pytest.mark.parametrize("zones", [("+02:00",) * 6, (" +0200",) * 6, ("-05:00", *["-06:00"] * 5)])
def test_a_zone_counts(zones, tmp_path):
    hours = np.array([int(zone.strip()[:3]) for zone in zones])
    stamps = [f"{at.isoformat()}{zone}" for at, zone in zip(TIMES, zones, strict=True)]
    path = stamped(tmp_path / "x.csv", stamps)
    assert_allclose(seconds(path), np.arange(6) - 3600 * (hours - hours[0]))


@pytest.mark.parametrize("form", ["%d-%b-%Y %H:%M:%S", "%m/%d/%y %H:%M:%S"])
def test_more_notations_of_dates_are_known(form, tmp_path):
    day = datetime.timedelta(days=20)  # no month
    path = stamped(tmp_path / "x.csv", [(at + day).strftime(form) for at in TIMES])
    assert_allclose(seconds(path), np.arange(6))


def test_elapsed_times_go_on_over_a_day(tmp_path):
    path = stamped(tmp_path / "x.csv", [f"{hours}:30:00" for hours in range(21, 27)])
    assert_allclose(seconds(path), 3600 * np.arange(6))


def test_dates_times_of_day_and_durations_of_a_workbook_are_known(tmp_path):
    """A date is a cell at midnight there, and a duration no number of days."""
    book = Workbook()
    book.active.append(["Date", "Time", "Heater [%]", "T1"])
    for k, at in enumerate(TIMES):
        book.active.append([at.date(), at.time(), int(k > 1), 20 + 0.7 * k])
    book.save(tmp_path / "x.xlsx")
    assert_allclose(seconds(tmp_path / "x.xlsx"), np.arange(6))
    book = Workbook()
    book.active.append(["Time", "Heater [%]", "T1"])
    for k in range(6):
        book.active.append([datetime.timedelta(hours=22 + k, seconds=0.5), int(k > 1), 20 + 0.7 * k])
    book.save(tmp_path / "y.xlsx")
    assert_allclose(seconds(tmp_path / "y.xlsx"), 3600 * np.arange(6))
