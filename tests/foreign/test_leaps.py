"""Readings that no joint can have had: left out where they leap away and back, refused where they stay away."""

import numpy as np
import pytest
from foreign_robots import imported, motion, servo

from sim2real.errors import UsageError
from sim2real.log import ImportMapping, import_file


@pytest.fixture(scope="module")
def recorded():
    return motion()


def saved(path, recorded, rows, value, unit=1.0):
    t, goal, q = recorded
    q = q.copy()
    q[rows, 0] = value
    np.savez(path, t_s=t, goal=unit * goal, q=unit * q)
    return path


@pytest.mark.parametrize(
    ("rows", "value"),
    [([500, 900], -np.pi), ([0], -np.pi), ([-1], -np.pi), ([500, 501, 900], -np.pi), (range(500, 505), -np.pi),
     ([370, 1131], 0.0), ([500, 900], 6553.5)],
)  # fmt: skip
@pytest.mark.parametrize("unit", [1.0, 180 / np.pi])
def test_readings_that_leap_away_and_back_are_left_out(tmp_path, recorded, rows, value, unit):
    path = saved(tmp_path / "run.npz", recorded, list(rows), value, unit)
    episode, found = imported(path)
    kept = np.setdiff1d(np.arange(2000), np.arange(2000)[list(rows)])
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], recorded[2][kept], atol=1e-12)
    assert f"{len(rows)} samples hold readings that leap away and back" in "\n".join(found.evidence)
    assert episode.metadata["source"]["dropped"] == {"actuator": 0, "sensor": len(rows)}


@pytest.mark.parametrize("rows", [range(500, 530), range(1500, 2000)])
def test_a_zero_that_changes_is_refused(tmp_path, recorded, rows):
    with pytest.raises(UsageError, match=rf"changes by .* rad before sample {rows[0]}, .* faster than a joint can"):
        imported(saved(tmp_path / "run.npz", recorded, list(rows), -np.pi, 180 / np.pi))


def test_many_leaps_are_refused(tmp_path, recorded):
    with pytest.raises(UsageError):
        imported(saved(tmp_path / "run.npz", recorded, list(range(7, 1990, 11)), -np.pi))


def test_fast_motions_are_no_leaps(tmp_path, recorded):
    t, _, _ = recorded
    goal = np.where((t % 1.0) < 0.5, -1.0, 1.0)[:, None]
    q = servo(t, goal[:, 0], wn=40.0)[:, None]
    np.savez(tmp_path / "run.npz", t_s=t, goal=goal, q_rad=q)
    np.testing.assert_allclose(imported(tmp_path / "run.npz")[0].outputs["sensor"]["position"], q)


def test_a_mapping_refuses_leaps_or_drops_them(tmp_path, recorded):
    path = saved(tmp_path / "run.npz", recorded, [500], -np.pi)
    node = {"stamps": "t_s", "fields": {"position": {"source": "q", "unit": "rad"}}}
    with pytest.raises(UsageError, match=r'(?s)reads -3.142 rad in sample 500.*implausible = "drop"'):
        import_file(path, ImportMapping.from_dict({"pipeline": "x", "nodes": {"sensor": node}}))
    dropping = ImportMapping.from_dict({"pipeline": "x", "nodes": {"sensor": {**node, "implausible": "drop"}}})
    assert len(import_file(path, dropping).steps["sensor"]) == 1999
