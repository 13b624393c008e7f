"""Tables, arrays and documents of other programs: what is read, and what is refused with the place and a way out."""

import gzip
import io
import json
import pickle
import zipfile

import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.log.importing.readers import open_tables


def read(path, text):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    (table,) = open_tables(path)
    return table


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("t,q\n0,1\n1,2\n", {"t": [0, 1], "q": [1, 2]}),
        ("# t q\n0 1\n1 2\n", {"t": [0, 1], "q": [1, 2]}),
        ("# made by x\n# t,q\n0,1.5\n1,2.5\n", {"t": [0, 1], "q": [1.5, 2.5]}),
        ("%time,field.q\n0,1\n1,2\n", {"time": [0, 1], "field.q": [1, 2]}),
        ("// t;q\n0,5;1\n1,5;2\n", {"t": [0.5, 1.5], "q": [1, 2]}),
        ("Robot X\nDate 1\n\nt;q\n0;1\n1;2\n", {"t": [0, 1], "q": [1, 2]}),
        ("t\tq\n0\t1,5\n1\t2,5\n", {"t": [0, 1], "q": [1.5, 2.5]}),
        ("t,q,\n0,1,\n1,2,\n", {"t": [0, 1], "q": [1, 2]}),
        (",q\n0,1\n1,2\n", {"column 0": [0, 1], "q": [1, 2]}),
        ("sep=;\nt;q\n0;1\n1;2\n", {"t": [0, 1], "q": [1, 2]}),
        ("t,q\n0,null\n1,2\n", {"t": [0, 1], "q": [np.nan, 2]}),
        ("t,on\n0,true\n1,False\n", {"t": [0, 1], "on": [1, 0]}),
        ("\ufefft,q\r\n0,1\r\n1,2\r\n", {"t": [0, 1], "q": [1, 2]}),
        ("t;q [\N{DEGREE SIGN}]\n0;1,5\n1;2,5\n".encode("cp1252"), {"q [\N{DEGREE SIGN}]": [1.5, 2.5]}),
        ('"t, s","q"\n0,1\n1,2\n', {"t, s": [0, 1], "q": [1, 2]}),
        ("0.5,1\n1.5,2\n", {"0": [0.5, 1.5], "1": [1, 2]}),
        ("t,q\n0,1\n1,2\n2,3", {"t": [0, 1], "q": [1, 2]}),  # 3 may be the beginning of 3.7
        ("t,state,q\n0,OK,1\n1,OK,2\n", {"t": [0, 1], "q": [1, 2]}),
        ("0.0,OK,1.5\n1.0,OK,2.5\n", {"0": [0, 1], "2": [1.5, 2.5]}),
        (
            "t,q\n2024-05-01T00:00:01.25Z,1\n2024-05-01T02:00:01.5+02:00,2\n",
            {"t": [1714521601250000000, 1714521601500000000], "q": [1, 2]},
        ),
        ("t,q,u\ns,deg,deg\n0,1,2\n1,2,3\n", {"t s": [0, 1], "q deg": [1, 2], "u deg": [2, 3]}),
        ("t,q,u\n[s],[rad],[V]\n0,1,2\n1,2,3\n", {"t [s]": [0, 1], "u [V]": [2, 3]}),
        (",goal,pos\nt,a,a\n0,1,2\n1,2,3\n", {"t": [0, 1], "goal a": [1, 2], "pos a": [2, 3]}),
        ("t,q\n1700000000000000001,1\n1700000000000000003,2\n", {"t": [1700000000000000001, 1700000000000000003]}),
    ],
)
def test_tables(tmp_path, text, columns):
    table = read(tmp_path / "x.csv", text)
    assert columns.keys() <= table.columns.keys()
    for name, values in columns.items():
        np.testing.assert_array_equal(table.columns[name], values)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("t,0,1\n0.0,1.5,2.5\n0.1,1.5,2.5\n", "'t'"),  # a header with numbers
        ("0.0,ERR,1.5\n0.1,1.2,2.5\n0.2,1.5,2.5\n", "'ERR'"),  # a sample with a word
        (",0,1\n0,1.5,2.5\n1,1.5,2.5\n", "counts its columns"),
        ("0,1,2\n0.1,1.5,2.5\n", "counts its columns"),
        ("t,q\n0,1\n1\n2,3\n", "line 3"),
        ("t,q,q\n0,1,2\n1,2,3\n", "'q'"),
        ("x,y,z\nt,q\n0,1\n1,2\n2,3\n", ""),
        ("t,q\n", "no line of numbers"),
        ("", "empty"),
        ("t,q\n0,1\n".encode("utf-16"), "UTF-16"),
    ],
)
def test_tables_that_are_unclear_are_refused(tmp_path, text, named):
    if not named:
        assert read(tmp_path / "x.csv", text).columns.keys() == {"t", "q"}
        return
    with pytest.raises(UsageError, match=named) as error:
        read(tmp_path / "x.csv", text)
    assert error.value.hint


def test_a_word_among_numbers_is_named_with_its_line_when_the_column_is_used(tmp_path):
    table = read(tmp_path / "x.csv", "t,q\n0,1\n1,warm\n2,3\n")
    with pytest.raises(UsageError, match=r"line 3.*'warm'"):
        table.signal("q")
    np.testing.assert_array_equal(table.signal("t"), [0, 1, 2])


def npz(**arrays):
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


@pytest.mark.parametrize("suffix", [".npz", ".csv", ".dat", ".json", ".mcap", ".db3"])
def test_the_content_decides_not_the_suffix(tmp_path, suffix):
    assert read(tmp_path / f"x{suffix}", npz(q=np.arange(3.0))).format == "npz"
    assert read(tmp_path / f"y{suffix}", json.dumps({"q": [1, 2, 3]})).format == "json"
    assert read(tmp_path / f"z{suffix}", "t,q\n0,1\n1,2\n").format == "csv"


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (b"SQLite format 3\0" + bytes(99), "ros2 bag convert"),
        (b"#ROSBAG V2.0\n" + bytes(99), "rosbags-convert"),
        (b"\x28\xb5\x2f\xfd" + bytes(99), "zstd -d"),
        (gzip.compress(b"t,q\n0,1\n", mtime=0), "gunzip"),
        (b"\x89HDF\r\n\x1a\n" + bytes(99), "h5py"),
        (b"MATLAB 5.0 MAT-file" + bytes(99), "loadmat"),
        (b"header:\n  stamp:\n    sec: 1\n", "rostopic echo -p"),
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        (b"<!DOCTYPE html><html>", "download the file itself"),
        (pickle.dumps({"u": [1.0]}, 2), "np.savez"),
        (bytes(257) + b"ustar" + bytes(250), "is binary"),
        (b"ULog\x01\x12\x35" + bytes(99), "ulog2csv"),
        (pickle.dumps({"u": [1.0]}), "np.savez"),
        (b"PK\x03\x04" + bytes(99), "complete"),
        (bytes(range(256)), "binary"),
    ],
)
@pytest.mark.parametrize("suffix", [".csv", ".mcap"])
def test_a_container_that_is_not_read_is_named_with_the_command_that_converts_it(tmp_path, content, named, suffix):
    with pytest.raises(UsageError, match=rf"(?s){named}"):
        read(tmp_path / f"x{suffix}", content)


@pytest.mark.parametrize(("entry", "named"), [("xl/workbook.xml", "Excel"), ("run.csv", "zip archive of run.csv")])
def test_an_archive_without_arrays_is_named(tmp_path, entry, named):
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as file:
        file.writestr(entry, "t,q\n")
    with pytest.raises(UsageError, match=named):
        open_tables(tmp_path / "x.npz")


def test_arrays(tmp_path):
    rows = np.zeros(3, [("a", "f8"), ("b", "i4")])
    table = read(tmp_path / "x.npz", npz(q=np.float32([[1, 2]]), n=np.int32([1]), names=np.array(["a"]), rows=rows))
    assert table.columns["q"].dtype == np.float32
    assert table.columns["n"].dtype == np.int64
    assert table.words == {"names": ["a"]}
    assert {"rows.a", "rows.b"} <= table.columns.keys()
    table = read(tmp_path / "y.npz", npz(q=np.arange(3.0), o=np.array([{}], object)))
    with pytest.raises(UsageError, match="never loaded"):
        table.signal("o")
    table = read(tmp_path / "z.npz", npz(q=np.arange(6.0).reshape(3, 2), t=np.zeros(3)))
    for columns in ("5", "2", "-3", "1:9", "5:9", "-3:", "1:1"):
        with pytest.raises(UsageError, match=f"no column {columns}"):
            table.signal(f"q[:,{columns}]")
    with pytest.raises(UsageError, match="no column 0"):
        table.signal("t[:,0]")
    for columns, chosen in (("1", [1, 3, 5]), ("-1", [1, 3, 5]), ("1:2", [[1], [3], [5]]), (":1", [[0], [2], [4]])):
        np.testing.assert_array_equal(table.signal(f"q[:,{columns}]"), chosen)


def test_a_damaged_array_is_refused_when_it_is_used(tmp_path):
    content = bytearray(npz(q=np.arange(50.0), u=np.arange(50.0)))
    place = content.index(np.float64(7.0).tobytes())
    content[place] ^= 255
    table = read(tmp_path / "x.npz", bytes(content))
    with pytest.raises(UsageError, match="damaged"):
        table.signal("q")
    assert len(table.signal("u")) == 50
    with zipfile.ZipFile(tmp_path / "y.npz", "w") as file:
        file.writestr(
            "q.npy", b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (10**15,), }\n"
        )
    assert open_tables(tmp_path / "y.npz")[0].broken.keys() == {"q"}


def test_documents(tmp_path):
    entries = [{"t": k, "state": {"q": [k, 2 * k]}, "on": k > 1} for k in range(3)]
    table = read(tmp_path / "x.json", json.dumps({"meta": {"kp": 7}, "entries": entries, "motor": "m1"}))
    np.testing.assert_array_equal(table.signal("entries[].state.q"), [[0, 0], [1, 2], [2, 4]])
    np.testing.assert_array_equal(table.signal("entries[].on"), [0, 0, 1])
    assert table.signal("meta.kp").shape == ()
    table = read(tmp_path / "y.json", "\n".join(json.dumps(e) for e in entries))
    np.testing.assert_array_equal(table.signal("[].t"), [0, 1, 2])
    for text, named in (
        ('{"a": [1, 2', "cut off"),
        ("[" * 100_000, ""),
        (json.dumps([{"a": 1}, {}]), "element 1"),
        ("{}", "no signals"),
    ):
        with pytest.raises(UsageError, match=named or None):
            read(tmp_path / "z.json", text)
    table = read(tmp_path / "z.json", json.dumps({"q": [1.0, None, 3.0], "r": [[1], [1, 2]], "w": [1, "off"]}))
    np.testing.assert_array_equal(table.signal("q"), [1, np.nan, 3])
    for name in ("r", "w"):
        with pytest.raises(UsageError, match="cannot be read"):
            table.signal(name)


@pytest.mark.parametrize("kind", ["npz", "json", "csv"])
def test_bytes_changed_at_random_are_read_or_refused(tmp_path, kind):
    rng = np.random.default_rng(7)
    columns = {"t_s": np.arange(40) / 50, "q_rad": np.sin(np.arange(40)), "goal_rad": np.cos(np.arange(40))}
    whole = {
        "npz": npz(**columns),
        "json": json.dumps({k: v.tolist() for k, v in columns.items()}).encode(),
        "csv": b"t_s,q_rad,goal_rad\n" + b"\n".join(b"%f,%f,%f" % row for row in zip(*columns.values(), strict=True)),
    }[kind]
    refused = 0
    for _ in range(60):
        data = bytearray(whole[: rng.integers(len(whole))] if rng.random() < 0.2 else whole)
        for _ in range(int(rng.choice((1, 3, 30))) if data else 0):
            data[rng.integers(len(data))] = rng.integers(256)
        try:
            read(tmp_path / "x", bytes(data))
        except UsageError:
            refused += 1
    assert refused
