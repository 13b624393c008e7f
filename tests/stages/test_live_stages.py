"""A search streams its best fit, a training its curves; ``view --follow`` joins, and ``--web`` serves browsers."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from collections import Counter

import pytest
from live_robots import TINY

from sim2real import cli

pytest.importorskip("rerun")
from rerun.chunk import RrdReader


def rows_of(path):
    rows = Counter()
    for chunk in RrdReader(path).stream().to_chunks():
        if not chunk.is_static:
            rows[chunk.entity_path] += chunk.num_rows
    return rows


def tiny(stage):
    return [f"--{flag.removeprefix(f'--{stage}.')}" for flag in TINY if flag.startswith(f"--{stage}.")]


@pytest.mark.night
def test_a_search_streams_its_loss_and_its_best_fit(run_copy, tmp_path):
    file = tmp_path / "identify.rrd"
    home = ["--run", str(run_copy), "--runs", str(run_copy.parent.parent)]
    assert cli.main(["identify", "pendulum", *home, *tiny("identify"), "--view", str(file)]) == 0
    rows = rows_of(file)
    (loss,) = [entity for entity in rows if "/loss/" in entity]
    assert rows[loss] > 3
    fits = {entity for entity in rows if "/fit_" in entity and entity.endswith("/th")}
    measured = next(rows[entity] for entity in rows if entity.endswith("/measured/th"))
    assert fits
    assert all(rows[entity] >= 100 for entity in fits)
    assert measured >= 100
    assert (run_copy / "identify.2" / "best_fit.npz").is_file()


@pytest.mark.night  # `make test` streams a search, above
def test_a_training_streams_its_curves_and_a_viewer_joins_it(run_copy, tmp_path):
    file = tmp_path / "train.rrd"
    home = ["--run", str(run_copy), "--runs", str(run_copy.parent.parent)]
    assert cli.main(["train", "pendulum", *home, *tiny("train"), "--view", str(file)]) == 0
    rows = rows_of(file)
    assert any(entity.endswith("/return/0") for entity in rows)
    assert any(entity.endswith("/success/0") for entity in rows)
    assert (run_copy / "train.2" / "progress.jsonl").is_file(), "a viewer joins a training that has none"


@pytest.mark.process
@pytest.mark.night
@pytest.mark.parametrize("follow", [True, False])
def test_a_run_is_served_to_browsers_until_ctrl_c(run_copy, follow):
    command = [sys.executable, "-m", "sim2real.cli", "view", str(run_copy), "--web", *(["--follow"] if follow else [])]
    environment = {**os.environ, "RERUN_ANALYTICS_ENABLED": "0"}
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as process:
        said = ""
        while "Ctrl-C" not in said:
            line = process.stderr.readline()
            assert line, said
            said += line
        address = re.search(r"open http://[^:]+:(\d+)/\?url=rerun%2Bhttp://[^:]+:(\d+)/proxy", said)
        assert address, said
        with contextlib.closing(urllib.request.urlopen(f"http://127.0.0.1:{address[1]}", timeout=10)) as page:
            assert "rerun" in page.read().decode().lower()
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        process.stderr.read()
        assert process.wait(20) == 0, "the view ends in order"
