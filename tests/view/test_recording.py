"""The Rerun recording: whole, on one timeline, by columns; and what is said without the viewer."""

from __future__ import annotations

import builtins
import os
import socket
import subprocess
import sys
import sysconfig
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import synthetic_run
from installed import need

from sim2real.artifacts.run import finished_stages
from sim2real.errors import Sim2RealError
from sim2real.stages.live import drawn, scene_of
from sim2real.stages.load import load_robot
from sim2real.view.rerun_content import tabs_of
from sim2real.view.rerun_recording import _COLORS, view

RERUN = Path(sysconfig.get_path("scripts")) / "rerun"
LAVAPIPE = Path("/usr/share/vulkan/icd.d/lvp_icd.x86_64.json")
FIRST_TAB = {"measured", "truth", "command"}
"""Roles of the curves in the tab that is open at first, that of the record stage."""
needs_rerun = pytest.mark.skipif(not RERUN.exists(), reason="rerun-sdk is not installed")


def rerun(*arguments: str | Path, **environment: str) -> str:
    """Run the viewer's command line and return what it says."""
    done = subprocess.run(
        [RERUN, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ, "RERUN_ANALYTICS_ENABLED": "0", **environment},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def saved(finished_run, tmp_path_factory):
    pytest.importorskip("rerun")
    path = tmp_path_factory.mktemp("rerun") / "run.rrd"
    view(finished_run, path, drawn(scene_of(load_robot("pendulum"))))
    return path


@needs_rerun
def test_the_recording_is_whole_by_the_viewers_own_check(saved):
    assert "1 file verified without error" in rerun("rrd", "verify", saved)


def test_every_curve_stands_on_the_one_timeline(saved, finished_run):
    rows = rows_by_entity(saved)
    for tab in tabs_of(finished_stages(finished_run)):
        for curve in (c for curves in tab.plots.values() for c in curves):
            assert rows[f"/{curve.entity}"] == len(curve.t_s), curve.entity
    for folder in ("record", "deploy/0", "deploy/1"):
        assert rows[f"/{folder}/lateness/agent"] == synthetic_run.STEPS
        assert rows[f"/{folder}/scene/robot/body_1"] == synthetic_run.STEPS
    assert rows["/deploy/0/scene/simulation/body_1"] == 400


def rows_by_entity(path: Path) -> Counter[str]:
    """Return entity -> rows on the timeline; any other timeline is a failure."""
    from rerun.chunk import RrdReader

    rows: Counter[str] = Counter()
    for chunk in RrdReader(path).stream().to_chunks():
        if not chunk.is_static:
            assert chunk.timeline_names == ["time"], chunk.entity_path
            rows[chunk.entity_path] += chunk.num_rows
    return rows


def test_a_record_alone_can_be_viewed_without_a_scene(tmp_path):
    pytest.importorskip("rerun")
    run = tmp_path / "pendulum" / "run"
    synthetic_run.write_stage(run, "record")
    view(run, tmp_path / "new" / "run.rrd")
    assert not [entity for entity in rows_by_entity(tmp_path / "new" / "run.rrd") if "scene" in entity]


def test_plots_bring_together_who_speaks_of_the_same(finished_run):
    tabs = {tab.title: tab for tab in tabs_of(finished_stages(finished_run))}
    assert list(tabs) == ["Record", "Deploy 0", "Deploy 1"]
    labels = {title: [c.label for c in curves] for title, curves in tabs["Deploy 0"].plots.items()}
    assert labels["th [rad]"] == ["measured by sensor", "true state", "simulation"]
    assert labels["action [V]"] == ["sent by actuator", "simulation"]
    command = tabs["Deploy 1"].plots["action [V]"][1]
    assert command.t_s[0] == pytest.approx(0.013), "the times that the simulation gave"


def test_the_pendulum_points_where_the_angle_says(saved):
    from rerun.chunk import RrdReader

    chunks = RrdReader(saved).stream().to_chunks()
    turns = next(c for c in chunks if c.entity_path == "/record/scene/robot/body_1" and not c.is_static)
    batch = turns.to_record_batch()
    column = next(c for c in batch.schema.names if "quaternion" in c)
    x, y, z, w = np.array([q[0] for q in batch.column(column).to_pylist()]).T
    np.testing.assert_allclose(2 * np.arctan2(y, w), np.sin(0.02 * np.arange(len(y))), atol=1e-5)
    assert not x.any()
    assert not z.any()


def test_without_the_viewer_the_error_names_the_extra(run, monkeypatch):
    real_import = builtins.__import__

    def no_rerun(name, *arguments, **keywords):
        if name.partition(".")[0] == "rerun":
            raise ModuleNotFoundError("No module named 'rerun'")
        return real_import(name, *arguments, **keywords)

    monkeypatch.setattr(builtins, "__import__", no_rerun)
    with pytest.raises(Sim2RealError, match="not installed") as caught:
        view(run, run / "run.rrd")
    assert "rerun-sdk" in caught.value.hint


def test_a_place_that_cannot_be_written_and_nothing_to_play_are_named(run, only, tmp_path):
    pytest.importorskip("rerun")
    with pytest.raises(Sim2RealError, match="cannot write"):
        view(run, run / "record" / "session.mcap" / "run.rrd")
    with pytest.raises(Sim2RealError, match="no recording and no deployment"):
        view(only("identify"), tmp_path / "run.rrd")


@pytest.mark.night
def test_importing_the_room_imports_no_viewer():
    code = "import sys, sim2real.view.rerun_recording, sim2real.view.page; sys.exit('rerun' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


def drawn_roles(path: Path, picture: Path, wait_s: float = 10.0) -> set[str]:
    """Open a recording in a viewer without a screen, and return the roles whose curves its window shows.

    The viewer draws before it has loaded everything, so the picture is repeated until it shows all curves of the first
    tab, at most for ``wait_s`` [s]. An error screen and an empty window have no curve.
    """
    from matplotlib.image import imread
    from rerun.experimental import ViewerClient

    roles: set[str] = set()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with ViewerClient.spawn(headless=True, port=port, hide_welcome_screen=True, executable_path=str(RERUN)) as viewer:
        viewer.open(str(path))
        end_s = time.monotonic() + wait_s
        while time.monotonic() < end_s and roles != FIRST_TAB:
            viewer.save_screenshot(str(picture))
            pixels = (imread(picture)[..., :3] * 255).round()
            sizes = {name: (np.abs(pixels - colour).max(axis=-1) < 8).sum() for name, colour in _COLORS.items()}
            roles = {name for name, size in sizes.items() if size > 200}
    return roles


@pytest.mark.night  # it waits for the pictures of a window
@needs_rerun
def test_the_viewer_draws_the_curves(saved, tmp_path, monkeypatch):
    need(LAVAPIPE.exists(), "a software Vulkan (mesa-vulkan-drivers)")
    monkeypatch.setenv("VK_ICD_FILENAMES", str(LAVAPIPE))
    monkeypatch.setenv("RERUN_ANALYTICS_ENABLED", "0")
    assert drawn_roles(saved, tmp_path / "run.png") == FIRST_TAB
