"""Tasks of a bench: a process each, on one processor, that ends with the bench."""

import argparse
import importlib
import os
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
sys.path.insert(0, str(SCRIPTS))
from benches import jobs  # noqa: E402

TASK = """
import os, time

def where(name, options):
    if name == "bad":
        raise ValueError(name)
    threads = os.environ["OPENBLAS_NUM_THREADS"]
    return {"name": name, "process": os.getpid(), "processors": os.sched_getaffinity(0), "threads": threads}
"""


@pytest.fixture
def where(tmp_path, monkeypatch):
    (tmp_path / "a_task.py").write_text(TASK)
    monkeypatch.syspath_prepend(tmp_path)
    sys.modules.pop("a_task", None)
    return importlib.import_module("a_task").where


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="only Linux holds a process on a processor")
def test_tasks_are_processes_of_one_thread_on_one_processor(where):
    before = dict(os.environ)
    done = dict(jobs.each(where, [("a",), ("b",), ("c",)], argparse.Namespace(jobs=2)))
    assert os.environ == before
    assert [done[i]["name"] for i in range(3)] == ["a", "b", "c"]
    assert len({task["process"] for task in done.values()} | {os.getpid()}) == 4
    assert all(task["threads"] == "1" and len(task["processors"]) == 1 for task in done.values())


def test_a_task_that_fails_ends_the_bench_but_a_robot_loses_no_other(where):
    before = dict(os.environ)
    with pytest.raises(ValueError, match="bad"):
        list(jobs.each(where, [("bad",)], argparse.Namespace(jobs=2)))
    assert os.environ == before
    one = lambda number, options: {"number": number, "share": 1 / number}  # noqa: E731
    done, failed = jobs.robots(one, range(3), argparse.Namespace(jobs=1))
    assert [robot["number"] for robot in done] == [1, 2]
    assert [robot["number"] for robot in failed] == [0]
