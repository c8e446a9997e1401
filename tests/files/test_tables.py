"""Tables are read strictly, written repeatably, and complain with file, line and column."""

from pathlib import Path

import numpy as np
import pytest

from trifix.errors import MapError, RecordingError
from trifix.files.tables import (
    LINE,
    fixed,
    from_upper_triangle,
    read_bare_table,
    read_table,
    significant,
    table_text,
    upper_triangle,
    write_atomically,
    write_table,
)

COLUMNS = {"frame": int, "u": float, "name": str}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "table.csv"


def test_columns_are_found_by_name_in_any_order_and_unknown_ones_are_ignored(file: Path) -> None:
    file.write_text("u,other,frame,name\n0.25,x,7,left\n-1e3,y,8,right\n")
    table = read_table(file, COLUMNS)
    assert table["frame"].tolist() == [7, 8]
    assert table["frame"].dtype == np.int64
    assert table["u"].tolist() == [0.25, -1000.0]
    assert table["name"].tolist() == ["left", "right"]
    assert "other" not in table


def test_comments_blank_lines_spaces_bom_and_windows_line_ends_are_no_matter(file: Path) -> None:
    file.write_bytes(
        b'\xef\xbb\xbf# made by hand\r\n\r\n frame , u ,name\r\n# a comment, "quoted\r\n 1, 2.5 , left \r\n'
    )
    table = read_table(file, COLUMNS)
    assert (table["frame"][0], table["u"][0], table["name"][0]) == (1, 2.5, "left")
    assert table[LINE].tolist() == [5]


def test_quoted_cells_may_hold_commas(file: Path) -> None:
    file.write_text('frame,u,name\n1,2,"left, or so"\n')
    assert read_table(file, COLUMNS)["name"].tolist() == ["left, or so"]


def test_a_table_without_rows_has_empty_columns(file: Path) -> None:
    file.write_text("frame,u,name\n")
    table = read_table(file, COLUMNS)
    assert [len(column) for column in table.values()] == [0, 0, 0, 0]
    assert table["u"].dtype == np.float64


def test_optional_columns_are_there_only_if_the_file_has_them_and_may_be_empty(file: Path) -> None:
    file.write_text("frame,sigma,label,state\n1,,,\n2,0.5,3,trusted\n")
    table = read_table(file, {"frame": int}, {"sigma": float, "label": int, "state": str, "absent": float})
    assert np.isnan(table["sigma"][0])
    assert table["sigma"][1] == 0.5
    assert table["label"].tolist() == [-1, 3]
    assert table["state"].tolist() == ["", "trusted"]
    assert "absent" not in table


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"table\.csv is empty: expected a header with the columns frame, u, name"),
        ("frame,U,name\n", r"column 'u' is missing; the header has frame, U, name"),
        ("fram,u,name\n", r"column 'frame' is missing.*\(is 'fram' meant\?\)"),
        ("frame,u,u,name\n", r"column 'u' stands 2 times in the header"),
        ("frame,u,name\n1,2,a\n1,2\n", r"line 3: found 2 cells, expected 3 \(frame, u, name\)"),
        ("frame,u,name\n1,2,a,b\n", r"line 2: found 4 cells, expected 3"),
        ("frame,u,name\n1,2,a\n2,two,b\n", r"line 3, column 'u': found 'two', expected a finite number"),
        ("frame,u,name\n1,nan,a\n", r"line 2, column 'u': found 'nan', expected a finite number"),
        ("frame,u,name\n1,2,a\n#\n1,-inf,a\n", r"line 4, column 'u': found '-inf', expected a finite number"),
        ("frame,u,name\n1,1_0,a\n", r"line 2, column 'u': found '1_0', expected a finite number"),
        ("frame,u,name\n1.5,2,a\n", r"line 2, column 'frame': found '1\.5', expected an integer"),
        ("frame,u,name\n99999999999999999999,2,a\n", r"line 2, column 'frame': found '9+', expected an integer"),
        ("frame,u,name\n,2,a\n", r"line 2, column 'frame': found an empty cell, expected an integer"),
        ("frame,u,name\n1,2,\n", r"line 2, column 'name': found an empty cell, expected text"),
        ('frame,u,name\n1,2,"a\n', r"line 4? ?.*is not CSV"),
    ],
)
def test_a_faulty_table_is_refused_with_the_place(file: Path, text: str, message: str) -> None:
    file.write_text(text)
    with pytest.raises(RecordingError, match=message):
        read_table(file, COLUMNS)


def test_values_that_are_not_finite_pass_only_where_the_caller_judges_them(file: Path) -> None:
    file.write_text("u,v\nnan,1\n2,inf\n")
    table = read_table(file, {"u": float, "v": float}, may_be_nan=("u", "v"))
    assert np.isnan(table["u"][0])
    assert np.isinf(table["v"][1])
    with pytest.raises(RecordingError, match="line 3, column 'v'"):
        read_table(file, {"u": float, "v": float}, may_be_nan=("u",))


def test_a_file_that_is_missing_a_folder_or_no_text_is_named(file: Path, tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"table\.csv does not exist"):
        read_table(file, COLUMNS, error=MapError)
    with pytest.raises(RecordingError, match="is a folder, expected a file"):
        read_table(tmp_path, COLUMNS)
    file.write_bytes(b"frame,\xff\xfe\n")
    with pytest.raises(RecordingError, match="is not text: byte 6 is not UTF-8"):
        read_table(file, COLUMNS)


def test_bare_tables_have_their_columns_in_order_and_any_white_space(file: Path) -> None:
    file.write_text("#t x\n 1.0   2\n\t3.0\t4 \n")
    table = read_bare_table(file, {"t": str, "x": float}, delimiter=" ")
    assert table["t"].tolist() == ["1.0", "3.0"]
    assert table["x"].tolist() == [2.0, 4.0]
    file.write_text("1 2 3\n")
    with pytest.raises(RecordingError, match=r"line 1: found 3 cells, expected 2 \(t, x\)"):
        read_bare_table(file, {"t": str, "x": float}, delimiter=" ")


def test_what_is_written_reads_back(file: Path) -> None:
    write_table(file, {"frame": ["1", "2"], "u": ["0.5", ""]})
    assert file.read_text() == table_text({"frame": ["1", "2"], "u": ["0.5", ""]}) == "frame,u\n1,0.5\n2,\n"
    assert read_table(file, {"frame": int}, {"u": float})["frame"].tolist() == [1, 2]


def test_columns_of_unequal_length_are_not_written() -> None:
    with pytest.raises(ValueError, match="shorter"):
        table_text({"a": ["1", "2"], "b": ["1"]})


def test_an_atomic_write_replaces_the_file_and_leaves_nothing_else(file: Path) -> None:
    file.write_text("old")
    write_atomically(file, "new")
    assert file.read_text() == "new"
    with pytest.raises(UnicodeEncodeError):
        write_atomically(file, "broken \ud800")
    assert file.read_text() == "new"
    assert [p.name for p in file.parent.iterdir()] == ["table.csv"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1 / 3, "0.333333"),
        (-0.0, "0.000000"),
        (-1e-9, "0.000000"),
        (-1e-6, "-0.000001"),
        (np.nan, ""),
        (1e7, "10000000.000000"),
    ],
)
def test_fixed_numbers_have_one_spelling(value: float, text: str) -> None:
    assert fixed(value) == text


@pytest.mark.parametrize(
    ("value", "text"), [(1.234567890123e-7, "1.23456789e-07"), (-0.0, "0"), (0.01, "0.01"), (np.nan, "")]
)
def test_significant_numbers_have_one_spelling(value: float, text: str) -> None:
    assert significant(value) == text


def test_the_upper_triangle_goes_row_by_row_and_back() -> None:
    cov = np.array([[[1.0, 2, 3], [2, 4, 5], [3, 5, 6]]])
    assert upper_triangle(cov).tolist() == [[1, 2, 3, 4, 5, 6]]
    A = np.random.default_rng(0).normal(size=(4, 6, 6))
    cov = A @ np.swapaxes(A, 1, 2)
    assert upper_triangle(cov).shape == (4, 21)
    np.testing.assert_array_equal(
        from_upper_triangle(upper_triangle(cov)), np.triu(cov) + np.swapaxes(np.triu(cov, 1), 1, 2)
    )
