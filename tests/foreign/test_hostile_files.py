"""Files that were made to cost much, or were damaged: an answer in words, soon, and in little memory."""

import contextlib
import io
import json
import random
import struct
import time
import tracemalloc
import warnings
import zipfile

import made_bags as bags
import numpy as np
import pytest

from sim2real.errors import Sim2RealError, UsageError
from sim2real.log import read_log
from sim2real.log.importing.files.foreign import open_foreign
from sim2real.log.importing.mapping import load_mapping
from sim2real.log.importing.proposal import propose
from sim2real.log.importing.quantities import ImportHints
from sim2real.log.importing.signals import collect

MOST_S, MOST_MB = 5.0, 60


def npy(shape, descr="<f8"):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": descr, "fortran_order": False, "shape": shape})
    return stream.getvalue()


def npz(path, entries):
    """Write an archive; an entry is bytes, and how many zeros follow them."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, (head, zeros) in entries.items():
            with archive.open(name, "w", force_zip64=True) as stream:
                stream.write(head)
                for _ in range(zeros >> 20):
                    stream.write(bytes(1 << 20))
    return path


def bomb(path):
    return npz(path, {"a.npy": (npy((140 << 20,)), 8 << 20)})


def parquet_of_zeros(path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    pq.write_table(pa.table({"a": pa.array(np.zeros(150_000_000, np.int8))}), path, compression="zstd")
    return path


def text(path, content):
    path.write_text(content)
    return path


def noise(path):
    path.write_bytes(b"\x89MCAP0\r\n" + random.Random(0).randbytes(1000))
    return path


HOSTILE = {
    "npz: an array of 1.1 GiB": lambda p: bomb(p / "x.npz"),
    "npz: many arrays": lambda p: npz(p / "x.npz", {f"{i}.npy": (npy((40 << 20,)), 0) for i in range(4)}),
    "npz: many entries": lambda p: npz(p / "x.npz", {f"{i}.npy": (b"", 0) for i in range(10_001)}),
    "npz: no headers": lambda p: npz(p / "x.npz", {"a.npy": (b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 65535, 0)}),
    "npz: negative": lambda p: npz(p / "x.npz", {"a.npy": (npy((-1,)), 0)}),
    "parquet: 150 million zeros": lambda p: parquet_of_zeros(p / "x.parquet"),
    "json: brackets": lambda p: text(p / "x.json", "[" * 100_000),
    "json: objects": lambda p: text(p / "x.json", '{"a":' * 65 + "1" + "}" * 65),
    "json: many keys": lambda p: text(p / "x.json", json.dumps({str(i): 0 for i in range(10_001)})),
    "json: long numbers": lambda p: text(p / "x.json", '{"a": [' + "1" * 5000 + "]}"),
    "csv: 300,000 columns": lambda p: text(p / "x.csv", ",".join(f"c{i}" for i in range(300_000)) + "\n"),
    "csv: a long cell": lambda p: text(p / "x.csv", 't,a\n0,"' + "x" * 200_000 + '"\n'),
    "csv: an open quote": lambda p: text(p / "x.csv", 't,a\n"' + "0,1\n" * 100_000),
    "mcap: random": lambda p: noise(p / "x.mcap"),
}  # fmt: skip


@pytest.mark.parametrize("what", HOSTILE)
def test_hostile_files_are_refused_soon_and_cheaply(tmp_path, what):
    path = HOSTILE[what](tmp_path)
    tracemalloc.start()
    begin = time.process_time()
    with pytest.raises(UsageError) as caught:
        open_foreign(path)
    seconds, most = time.process_time() - begin, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert caught.value.hint
    assert len(str(caught.value)) < 1000
    assert seconds < MOST_S
    assert most < MOST_MB * 1e6


def test_arrays_that_are_too_large_or_no_numbers_stop_no_others(tmp_path):
    frames = np.zeros((5, 8, 8, 3), np.uint8)
    words = np.array(["a", "b"])
    np.savez(
        tmp_path / "x.npz", q=np.zeros(3), frames=frames, words=words, odd=np.array([{}]), wide=np.zeros((2, 1001))
    )
    file = open_foreign(tmp_path / "x.npz")
    assert file.keys == ["q", "words"]  # words may be numbers, or dates
    assert "skipped, as they hold no numbers: words" in collect(file)[1]
    for name, why in (("frames", "4 dim"), ("odd", "no numbers"), ("wide", "1001 columns")):
        assert any(name in note and why in note for note in file.notes)
    assert file.signal("frames").shape == frames.shape  # a mapping may name it
    with pytest.raises(UsageError, match=r"1001 columns.*at most 1000"):
        file.signal("wide")
    assert file.signal("wide[:,0:2]").shape == (2, 2)
    with pytest.raises(UsageError, match="Python objects"):
        file.signal("odd")


def test_many_columns_without_a_name_are_refused_before_each_is_compared_with_each(tmp_path):
    table = np.cumsum(np.random.default_rng(0).normal(size=(60, 400)), axis=0)
    np.savetxt(tmp_path / "x.csv", table, delimiter=",", header=",".join(f"x{i}" for i in range(400)), comments="")
    with pytest.raises(UsageError, match=r"401 signals are too many to compare.* more\n") as caught:
        propose(open_foreign(tmp_path / "x.csv"), ImportHints("rig", rate_hz=50.0))
    assert len(str(caught.value)) < 1500


def test_a_mapping_that_is_nested_too_deep(tmp_path):
    (tmp_path / "m.toml").write_text("a = " + "[" * 20_000)
    with pytest.raises(UsageError, match="no TOML"):
        load_mapping(tmp_path / "m.toml")


def record(opcode, content=b""):
    return struct.pack("<BQ", opcode, len(content)) + content


def named(name):
    return struct.pack("<I", len(name)) + name


TINY = {
    "private": record(0x91),
    "messages of no channel": record(5, bytes(22)),
    "metadata": record(12, named(b"x") + named(b"")),
    "ends of a session": record(12, named(b"session_end") + named(b"")) + b"\0",
    "empty chunks": record(6, bytes(28) + named(b"") + bytes(8)),
    "chunks that claim 200 MB": record(6, struct.pack("<QQQI", 0, 0, 200 << 20, 1) + named(b"zstd") + bytes(8)),
}


@pytest.mark.parametrize("what", TINY)
def test_tiny_records_cost_time_in_proportion(tmp_path, what):
    count = 20_000
    begin = b"\x89MCAP0\r\n" + record(1, named(b"ros2") + named(b"x"))
    (tmp_path / "x.mcap").write_bytes(begin + TINY[what] * count)
    clock = time.process_time()
    with contextlib.suppress(Sim2RealError), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        read_log(tmp_path / "x.mcap")
    assert time.process_time() - clock < 100e-6 * count + 1  # some 3 to 30 us each


def seeds(tmp_path):
    """Return a valid file of each format."""
    columns = {"t": np.arange(60) / 50, "q_rad": bags.Q[:60], "goal_rad": bags.GOAL[:60]}
    np.savez_compressed(tmp_path / "x.npz", **columns)
    (tmp_path / "x.json").write_text(json.dumps({k: v.tolist() for k, v in columns.items()}))
    table = np.column_stack([columns["t"], columns["q_rad"], columns["goal_rad"]])
    np.savetxt(tmp_path / "x.csv", table, delimiter=";", header="t;a_q_rad;b_q_rad;a_goal_rad;b_goal_rad", comments="")
    bags.write(tmp_path / "x.mcap", bags.rows(stop=60))
    found = ["x.npz", "x.json", "x.csv", "x.mcap"]
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        return found
    pq.write_table(pa.table({k: list(v) for k, v in columns.items()}), tmp_path / "x.parquet")
    return [*found, "x.parquet"]


@pytest.mark.parametrize("count", [40, pytest.param(400, marks=pytest.mark.night)])
def test_files_with_flipped_bytes_are_read_or_refused_in_words(tmp_path, count):
    rng, refused = random.Random(7), 0
    for name in seeds(tmp_path):
        whole = (tmp_path / name).read_bytes()
        for _ in range(count):
            data = bytearray(whole[: rng.randrange(len(whole))] if rng.random() < 0.2 else whole)
            for _ in range(rng.choice((1, 1, 3, 30))):
                if data:
                    data[rng.randrange(len(data))] = rng.randrange(256)
            path = tmp_path / f"flipped.{name.partition('.')[2]}"
            path.write_bytes(data)
            try:
                propose(open_foreign(path), ImportHints("rig"))
            except Sim2RealError:
                refused += 1
    assert refused
