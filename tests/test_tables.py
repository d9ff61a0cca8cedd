"""Tables as programs write them: however they are written, the numbers are the same."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from derjax.core.errors import InputError
from derjax.io.tables import normalised, read_table

NUMBERS = np.array([[0.0, -10.367, 1370.5], [0.5, np.nan, -2.25e-3], [1.0, 7.0, 0.125]])

HEADERS = {
    0: [],
    1: [["time", "x µm", "y"]],
    2: [["mass A", "", ""], ["time", "x µm", "y"]],
    3: [["scorer", "net", "net"], ["bodyparts", "time", "time"], ["coords", "x µm", "y"]],
    4: [["time", "x µm", "y"], ["Time", "X", "Y"], ["T", "X", "Y"], ["(s)", "(mm)", "(mm)"]],
}


def table_at(path: Path, text: str, encoding: str = "utf-8"):
    path.write_bytes(text.encode(encoding))
    return read_table(path)


def cell(value: float, decimal: str, quoted: bool, missing: str) -> str:
    text = missing if np.isnan(value) else repr(float(value)).replace(".", decimal)
    return f'"{text}"' if quoted else text


@settings(deadline=None, max_examples=150, suppress_health_check=list(HealthCheck))
@given(
    delimiter=st.sampled_from([",", ";", "\t", "  "]),
    decimal=st.sampled_from([".", ","]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "cp1252"]),
    rows=st.integers(0, 4),
    quoted=st.booleans(),
    trailing=st.booleans(),
    missing=st.sampled_from(["NaN", "null", "-", ""]),
    newline=st.sampled_from(["\n", "\r\n", "\r"]),
    comment=st.booleans(),
)
@example(",", ",", "cp1252", 3, True, True, "", "\r\n", True)
def test_however_it_is_written_the_numbers_are_the_same(
    tmp_path, delimiter, decimal, encoding, rows, quoted, trailing, missing, newline, comment
):
    quoted = quoted or (delimiter == decimal)
    missing = missing or ("" if delimiter != "  " or quoted else "NaN")
    header = [[f'"{name}"' if quoted or delimiter == "  " else name for name in row]
              for row in HEADERS[rows]]  # fmt: skip
    body = [[cell(value, decimal, quoted, missing) for value in row] for row in NUMBERS]
    lines = [delimiter.join(row) + delimiter * trailing for row in [*header, *body]]
    text = newline.join(["# filmed", "", *lines] if comment else lines) + newline
    table = table_at(tmp_path / "table.txt", text, encoding)
    names = {0: ["1", "2", "3"], 3: ["coords", "x \N{GREEK SMALL LETTER MU}m", "y"]}.get(
        rows, ["time", "x µm", "y"]
    )
    np.testing.assert_array_equal(table.numbers(names).values, NUMBERS)
    assert table.numbers(names).lines[0] == 1 + rows + 2 * comment


SPOTS = """LABEL,TRACK_ID,POSITION_X,POSITION_T
Label,Track ID,X,T
Label,Track ID,X,T
,,(mm),(sec)
ID100,0,139.63,0.0
ID101,1,138.2,0.0
ID102,,137.4,1.0
"""


def test_words_between_numbers_do_not_mislead(tmp_path):
    table = table_at(tmp_path / "a.csv", "LABEL;KIND;x\nID1;spot;1,5\nID2;spot;2,5\n")
    assert table.numbers(["x"]).values.tolist() == [[1.5], [2.5]]
    table = table_at(tmp_path / "b.csv", "t,Label,x\n0,film;a,1.5\n1,film;b,2.5\n")
    assert table.numbers(["t", "x"]).values.tolist() == [[0, 1.5], [1, 2.5]]
    table = table_at(tmp_path / "c.txt", "LABEL\tKIND\tx\nID1\tspot, red\t1,5\n")
    assert table.numbers(["x"]).values.tolist() == [[1.5]]


def test_a_column_goes_by_any_of_its_names(tmp_path):
    table = table_at(tmp_path / "spots.csv", SPOTS)
    assert table.names == ("LABEL", "TRACK_ID", "POSITION_X", "POSITION_T")
    np.testing.assert_array_equal(table.numbers(["POSITION_T", "T", "X"]).values[2], [1, 1, 137.4])
    assert table.text("Track ID") == ["0", "1", ""]
    assert table.numbers(["X"], where=("TRACK_ID", ["1.0"])).values.tolist() == [[138.2]]
    with pytest.raises(InputError, match=r"spots\.csv: no column 'Z'; .* 'LABEL', 'TRACK_ID'"):
        table.column("Z")


def test_names_that_several_columns_have_are_made_of_all_rows(tmp_path):
    text = "scorer,n,n,n,n\nbodyparts,head,head,tail,tail\ncoords,x,y,x,y\n0,1,2,3,4\n"
    table = table_at(tmp_path / "dlc.csv", text)
    assert table.names[1:] == ("head x", "head y", "tail x", "tail y")
    assert table.numbers(["coords", "tail x"]).values.tolist() == [[0, 3]]
    with pytest.raises(InputError, match=r"line 1: two columns .* 'x': 'head x', 'tail x'"):
        table.column("x")
    text = "mass_A\t\t\tmass_B\t\t\nt\tx\ty\tt\tx\ty\n0.0\t1,5\t2\t0.0\t3\t4\n"
    names = table_at(tmp_path / "tracker.txt", text).names
    assert names[:4] == ("mass_A t", "mass_A x", "mass_A y", "mass_B t")


def test_columns_without_a_name_have_their_number(tmp_path):
    table = table_at(tmp_path / "results.csv", " ,Area,X\n1,0,15.5\n2,0,16.5\n")
    assert table.names == ("1", "Area", "X")
    assert table.numbers(["1"]).values.tolist() == [[1], [2]]
    table = table_at(tmp_path / "frame.csv", ",0,1\n0,0.5,1.5\n1,0.6,1.6\n")
    assert table.numbers(["1"]).values.tolist() == [[1.5], [1.6]]  # the column whose name is 1


def test_a_comment_may_be_the_header(tmp_path):
    table = table_at(tmp_path / "saved.txt", "# filmed in May\n# t x\n0 1.5\n1 2.5\n")
    assert table.names == ("t", "x")
    table = table_at(tmp_path / "saved.txt", "# filmed in May\n0 1.5\n1 2.5\n")
    assert table.names == ("1", "2")


def test_what_stands_above_the_header_is_left_out(tmp_path):
    text = "Format Version,1.23,Rate,30.0,Units,Meters\n\nFrame,Time (Seconds),X\n0,0.0,1.5\n"
    table = table_at(tmp_path / "take.csv", text + "1,0.1,1.6\n2,0.2,1.7\n")
    assert table.numbers(["Time (Seconds)", "X"]).values[1].tolist() == [0.1, 1.6]


@pytest.mark.parametrize(
    ("cells", "seconds"),
    [
        (["00:00:07.000", "00:00:07.5"], [7.0, 7.5]),
        (["1:02", "1:03,25"], [62.0, 63.25]),
        (["23:59:59", "00:00:01"], [86399.0, 86401.0]),
        (["5", "6"], [5, 6]),
    ],
)
def test_times_of_a_clock(tmp_path, cells, seconds):
    text = "t;x\n" + "".join(f"{time};1\n" for time in cells)
    found = table_at(tmp_path / "clock.csv", text).numbers(["t", "x"], clock="t")
    np.testing.assert_allclose(found.values[:, 0], seconds, rtol=1e-12)
    assert found.is_clock == (":" in cells[0])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "the file is empty"),
        ("\n# nothing\n", "the file is empty"),
        ("t,x\n", "has a header but no rows"),
        ("t,x\n\n", "has a header but no rows"),
        ("a,b\nb,c\nc,d\nd,e\ne,f\nf,g\n", "the first 6 lines hold no numbers"),
        ("t,x\n0,1\n1,lost\n", "line 3 (row 2), column 'x': not a number: 'lost'"),
        ("t,x\n0,1\n\n1,inf\n", "line 4 (row 2), column 'x': not a number: 'inf'"),
        ("t,x\n0,1_000\n", "not a number: '1_000'"),
        ("t,x\n0,1\n1\n", "line 3: 1 fields, but the header has 2"),
        ("t,x\n0,1,5\n1,2,5\n", "line 2: 3 fields, but the header has 2; if there are decimal"),
        ("t;x\n0;1,5\n1;2.5\n2;3,5\n", "line 3 (row 2), column 'x': not a number: '2.5'; the dec"),
        ("t\tx\n0\t999\n1\t1,000\n2\t1,001\n", "column 'x': commas seem to separate thousands"),
        ("t,x\n0:00:00:03,1\n", "'0:00:00:03' seems to be hours:minutes:seconds:frames"),
        ("t,x\n0,00:00:01\n", "column 'x': not a number: '00:00:01' is a time of a clock"),
        ("t,x\n0,1\n00:00:01,2\n", "column 't': has times of a clock and plain numbers"),
        ('t,x\n0,"1\n1,2\n', "a quotation mark is not closed"),
        ("t|x\n0|1\n", "no columns in 't|x': tabs, semicolons, commas, spaces separate"),
        ("y,x\n0,1\n", "no column 't'; the columns are 'y', 'x'"),
        ("0,1.5\n0,2.5\n", "there is no header: columns are called by their numbers"),
    ],
)
def test_complaints(tmp_path, text, expected):
    with pytest.raises(InputError) as caught:
        table_at(tmp_path / "table.csv", text).numbers(["t", "x"], clock="t")
    assert str(caught.value).startswith(f"{tmp_path / 'table.csv'}: ")
    assert expected in str(caught.value)


@pytest.mark.parametrize(
    ("content", "expected"),
    [(b"PK\x03\x04\0\0", "a workbook"), (b"\x89HDF\r\n", "HDF5"), (b"\1\0\2\3\4", "is not text")],
)
def test_files_that_are_no_text(tmp_path, content, expected):
    (tmp_path / "a.csv").write_bytes(content)
    with pytest.raises(InputError, match=expected):
        read_table(tmp_path / "a.csv")


def test_missing_file_and_directory(tmp_path):
    with pytest.raises(InputError, match=r"none\.csv: no such file"):
        read_table(tmp_path / "none.csv")
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        read_table(tmp_path)


def test_names_that_look_the_same_are_the_same():
    assert normalised(" X\N{NO-BREAK SPACE}(\N{MICRO SIGN}m) ") == normalised(
        "X (\N{GREEK SMALL LETTER MU}m)"
    )
