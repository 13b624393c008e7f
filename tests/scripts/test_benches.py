"""Every bench runs with --quick, and its report says what it is of; figures are not looked at.

Those that train, search, trace MJX or start processes for seconds are ``full``. In `make test` the others say that
``bench.main`` makes a report of rows, ``train`` that a training can be measured, and
``test_help_shows_the_flags_of_a_bench`` that each module can be imported and has its flags and its quick ones.
"""

import ast
import importlib.util
import json
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
sys.path.insert(0, str(SCRIPTS))
import bench  # noqa: E402
from benches import provenance  # noqa: E402
from benches.catalogue import BENCHES  # noqa: E402
from benches.graph import mjx as graph_mjx  # noqa: E402
from benches.processor_time import suite  # noqa: E402

MODULES = sorted(SCRIPTS.rglob("*.py"))


@pytest.fixture(scope="module", autouse=True)
def quick_to_compile():
    """What runs for milliseconds need not be compiled for speed."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def run(tmp_path, capsys):
    """Run a bench; return its report, what it printed, and what it said."""

    def run(name, *flags):
        path = tmp_path / "report.json"
        assert bench.main([name, "--quick", "--json", str(path), *map(str, flags)]) == 0
        told = capsys.readouterr()
        report = json.loads(path.read_text())
        assert (report["bench"], report["quick"]) == (name, True)
        assert "measure nothing" in told.err
        assert report["measured"]
        for row in report["rows"]:
            assert set(row) == {"name", "value", "unit", "yardstick", "goal"}
            assert row["name"] in told.out
        return report

    return run


def test_a_report_names_files_without_the_folders_of_this_machine(tmp_path):
    flags = {"data": tmp_path / "data", "seeds": [0], "keep": None}
    assert bench.reported_flags(flags) == {"data": "data", "seeds": [0], "keep": None}


@pytest.fixture
def traced(monkeypatch):
    """Programs on MJX are traced but not compiled, which would take three quarters of the time."""

    def compare(programs, starts, repeats):
        for program in programs.values():
            jax.eval_shape(jax.vmap(program), starts)
        return dict.fromkeys(programs, 1.0), dict.fromkeys(programs, 1.0)

    monkeypatch.setattr(graph_mjx, "compare", compare)


def names(report):
    return {row["name"] for row in report["rows"]}


@pytest.mark.night
def test_graph(run, traced):
    found = names(run("graph", "--name", "h200"))
    assert {"graph/h200/hiccups/2/over_hand", "graph/h200/mjx_arm/2/over_bare", "graph/bytes_per_copy"} <= found
    assert "graph/build/10_episodes_wire_s" in found


@pytest.mark.night
def test_train(run):
    report = run("train", "--seeds", 2)
    name = f"train/{jax.default_backend()}/pendulum/2_seeds"
    rows = {row["name"].removeprefix(f"{name}/"): row["value"] for row in report["rows"]}
    assert len(rows["final_success"]) == 2
    assert rows["env_steps_per_s"] > 0
    assert rows["time_to_0.95_all_s"] is None
    assert report["machine"]["devices"]


@pytest.mark.night
def test_scaling(run):
    name = f"scaling/{jax.default_backend()}"
    found = names(run("scaling"))
    assert {f"{name}/train/1_devices/{n}" for n in ("env_steps_per_s", "compile_s")} <= found
    assert {f"{name}/identify/1_devices/{n}" for n in ("candidates_per_s", "compile_s")} <= found


@pytest.mark.night
def test_randomise(run):
    report = run("randomise", "--ways", "all", "--record-s", 12)  # a length whose programs other tests compile, too
    found = {row["name"]: row["value"] for row in report["rows"]}
    low, share, high = (found[f"randomise/all/{n}"] for n in ("low95", "success", "high95"))
    assert 0.0 <= low <= share <= high <= 1.0
    (robot,) = report["robots"]
    assert 0.7 * 26 < robot["truth"]["gain"] < 1.3 * 28
    assert robot["identified"]["gain"] == pytest.approx(robot["truth"]["gain"], rel=0.3)


@pytest.mark.night
def test_drift(run):
    report = run("drift", "--changes", "friction")
    (robot,) = report["robots"]
    tested = robot["changes"]["friction"]
    rows = {r["name"].removeprefix("drift/pendulum/friction/"): r["value"] for r in report["rows"]}
    assert rows["detected"] == bool(tested["alarms"])
    assert rows["named"] == (tested["named"] == "friction")
    assert rows["not_tested"] == 0
    assert {c["name"] for c in tested["changes"]} >= {"friction", "payload", "round_trip_delay"}


@pytest.mark.night
def test_view(run):
    pytest.importorskip("rerun")
    found = names(run("view"))
    assert found == {f"view/file/{n}" for n in (
        "loop_share", "loop_share_catching_up", "other_log_share", "writes_added",
        "lateness_p99_ms", "lateness_p99_added_ms", "viewer_cores",
    )}  # fmt: skip


@pytest.mark.night
def test_excitation(run):
    assert "excitation/teleoperated/friction_error" in names(run("excitation"))


def test_async(run):
    assert {"graph/simulated/steps_per_s", "async/100_hz/agent/lateness_ms", "async/100_hz/cpu"} <= names(run("async"))


@pytest.mark.night
def test_compose(run):
    assert "compose/step_ms" in names(run("compose", "--parts", "step"))


@pytest.mark.night
def test_compose_on_warp(run):
    pytest.importorskip("warp", reason='Warp is not installed: pip install "sim2real[warp]"')
    name = f"compose/{jax.default_backend()}/warp/2"
    assert {f"{name}/env_over_bare", f"{name}/graph_over_bare"} <= names(run("compose", "--parts", "warp"))


def test_compose_without_warp_leaves_its_rows_out(monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert bench.main(["compose", "--quick", "--parts", "warp"]) == 0
    assert "MuJoCo Warp is not installed, its rows are missing" in capsys.readouterr().err


@pytest.mark.night
def test_runner(run):
    found = {row["name"]: row["value"] for row in run("runner")["rows"]}
    assert 0.0 < found["runner/numpy/32-64-64-8/p50_us"] < found["runner/numpy/32-64-64-8/p99_us"]
    assert len(found["runner/12_joints_50_hz/actuator/lateness_ms"]) == 3
    assert found["runner/12_joints_50_hz/lost_replies"] < 10, "a busy machine may miss an answer or two of 25"


def test_log(run):
    report = run("log")
    rows = {row["name"]: row["value"] for row in report["rows"]}
    assert rows["log/truncations/opened"] == 3
    assert {"log/loop_200hz/p99_ms", "log/range_read_ms"} <= set(rows)


@pytest.mark.night  # `make test` reads the outcome of such a run, below
def test_suite(run):
    report = run("suite")
    rows = {r["name"].removeprefix("suite/"): r["value"] for r in report["rows"]}
    assert (rows["passed"], rows["skipped"], rows["failed"], report["failed"]) == (3, 0, 0, [])
    assert rows["processor_over_cold"] == pytest.approx(rows["processor_s"], abs=0.1), "the yardstick is set to 1 s"
    assert 0.1 < rows["processor_s"] < 60.0, "Python and pytest start in a few tenths of a second"
    assert list(report["rooms"]) == ["test_plain_pytree"]


@pytest.mark.night
def test_identify_time(run):
    """The second log of the same length finds all programs of the first: so says tests/identify/test_programs.py."""
    rows = {r["name"].removeprefix("identify-time/"): r["value"] for r in run("identify-time")["rows"]}
    assert rows["pendulum/second_log/misses"] == 0
    assert 1.0 < rows["pendulum/second_log/over_cold"] < 300.0, "the yardstick is set to 1 s"


def test_the_outcome_of_tests_is_read_from_pytests_report(tmp_path):
    path = tmp_path / "report.xml"
    cases = {"log.test_a": "", "log.test_b": "<skipped/>", "view.test_c": "<failure/>", "view.test_d": "<error/>"}
    rows = "".join(f'<testcase classname="tests.{n}" name="t" time="1.5">{e}</testcase>' for n, e in cases.items())
    path.write_text(f"<testsuites><testsuite>{rows}</testsuite></testsuites>")
    found = suite.outcome(path)
    assert (found.passed, found.skipped) == (1, 1)
    assert found.failed == ("tests.view.test_c::t", "tests.view.test_d::t")
    assert found.rooms == {"log": 3.0, "view": 3.0}


@pytest.mark.night
def test_tests_that_cannot_run_are_an_error_with_a_hint(capsys):
    assert bench.main(["suite", "--quick", "--paths", "tests/no_such_room"]) == 1
    told = capsys.readouterr().err
    assert "pytest ended with exit code 4" in told
    assert "\nhint: " in told


@pytest.fixture(scope="module")
def disk(tmp_path_factory):
    """A recording in the form of the disk's, of a pendulum that is pushed about."""
    voltage = np.repeat(np.random.default_rng(0).uniform(-2, 2, 50), 10)
    state, angles = np.zeros(2), []
    for u in voltage:
        for _ in range(5):
            state = state + 0.005 * np.array([state[1], 50.0 * u - 100.0 * np.sin(state[0]) - 5.0 * state[1]])
        angles.append(state[0])
    path = tmp_path_factory.mktemp("disk") / "disk.npz"
    np.savez(path, u=voltage, th=np.array(angles))
    return path


@pytest.mark.night
def test_identify(run, disk):
    """Ours beside MuJoCo's sysid, as the league compares them in ``test_league``."""
    pytest.importorskip("mujoco.sysid")
    report = run("identify", "--data", disk)
    assert {"identify/disk/fit_s", "identify/disk/free_run_over_sysid"} <= names(report)
    assert report["flags"]["data"] == disk.name
    assert report["values"][0]["delay"] >= 0


@pytest.fixture(scope="module")
def servo(tmp_path_factory):
    """Recordings in the form of the STS3250's: a lag and a dead time behind the goal, three motions."""
    folder = tmp_path_factory.mktemp("league") / "bam_sts3250"
    folder.mkdir()
    t = 0.02 * np.arange(150)
    for i, name in enumerate(("sin_sin", "up_and_down", "lift_and_drop")):
        goal, q = 0.5 * np.sin((2 + i) * t), np.zeros(150)
        for k in range(1, 150):
            q[k] = q[k - 1] + 0.3 * (goal[k - 1] - q[k - 1])
        rows = zip(t, goal, q, strict=True)
        entries = [{"timestamp": a, "goal_position": b, "position": c, "torque_enable": True} for a, b, c in rows]
        about = {"kp": 32, "vin": 12.0, "mass": 1.0, "length": 0.1, "trajectory": name, "entries": entries}
        (folder / f"{name}.json").write_text(json.dumps(about))
    return folder.parent


@pytest.mark.night
def test_league(run, servo, tmp_path):
    pytest.importorskip("mujoco.sysid")
    kept = tmp_path / "kept.jsonl"
    flags = ("--data", servo, "--sets", "sts3250", "--results", kept, "--entrants")
    report = run("league", *flags, "sysid_delay", "pace", "bam_m1")
    rows = {r["name"].removeprefix("league/sts3250/"): r for r in report["rows"]}
    assert all(
        0 < rows[f"{e}/{w}"]["value"] < 1e3 for e in ("sysid_delay", "pace", "bam_m1") for w in ("mean", "worst")
    )
    before = kept.read_text()
    assert len(before.splitlines()) == 3
    again = run("league", *flags, "pace", "bam_m1", "--jobs", 2)
    assert kept.read_text() == before, "nothing that was measured is measured again"
    assert {f["value"] for f in again["folds"]} == {
        f["value"] for f in report["folds"] if f["entrant"] in ("pace", "bam_m1")
    }


@pytest.mark.parametrize(
    ("data", "flags", "words"),
    [
        ("nothing.npz", [], "nothing.npz is no file *.npz and no folder with such files"),
        ("disk.npz", ["--fit", "other.npz@0:10"], "'other.npz@0:10' selects no part of disk.npz"),
        ("disk.npz", ["--case", "xl330"], "is no file *.json and no folder with such files"),
        ("disk.npz", ["--case", "so101_log", "--fit", "step_response"], "'step_response' selects no part of disk.npz"),
    ],
)
def test_data_that_is_not_there_is_said_in_words(disk, capsys, data, flags, words):
    assert bench.main(["identify", "--data", str(disk.with_name(data)), *flags]) == 2
    told = capsys.readouterr().err
    assert words in told
    assert "\nhint: " in told


@pytest.mark.parametrize("name", BENCHES)
def test_help_shows_the_flags_of_a_bench(name, capsys):
    with pytest.raises(SystemExit) as end:
        bench.main([name, "--help"])
    told = capsys.readouterr().out
    assert end.value.code == 0
    assert "--quick" in told
    module = importlib.import_module(f"benches.{BENCHES[name].module}")
    assert callable(module.run)
    flags = {*module.QUICK} - ({"flags"} if name in ("arm", "demo", "so101") else set())  # those are positional
    assert all(f"--{flag.replace('_', '-')}" in told for flag in flags)


def test_help_lists_the_benches(capsys):
    with pytest.raises(SystemExit):
        bench.main(["--help"])
    told = capsys.readouterr().out
    assert all(f"  {name} " in told for name in BENCHES)


def test_the_commit_of_a_copy_can_be_told(run, monkeypatch):
    monkeypatch.setattr(provenance, "_git", lambda *_: None)
    assert run("log", "--commit", "abc1234")["commit"] == "abc1234"


@pytest.mark.parametrize("module", MODULES, ids=lambda m: m.name)
def test_scripts_stay_short(module):
    text = module.read_text()
    assert len(text.splitlines()) <= 400
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            assert node.end_lineno - node.lineno < 60, node.name


@pytest.mark.night
def test_carried(run):
    rows = {row["name"].removeprefix("carried/"): row["value"] for row in run("carried")["rows"]}
    assert set(rows) == {"seconds", "terms", "gravcomp", "stiffness_error", "verdict"}
    assert rows["terms"] == "gravcomp"
    assert 0.0 < rows["gravcomp"] <= 1.5


@pytest.mark.night
def test_legs_identify(run):
    report = run("legs-identify")
    (twin,) = report["twins"]
    assert set(twin["errors"]) == {"damping", "friction", "armature", "strength"}
    assert len(twin["errors"]["strength"]) == 12
    rows = {row["name"]: row["value"] for row in report["rows"]}
    assert rows["legs_identify/strength/worst"] == pytest.approx(100 * max(twin["errors"]["strength"]), rel=1e-3)


@pytest.mark.parametrize(
    "flags", [("walk-train",), ("walk-rival",), ("walk-delays", "--policies", "wide", "--delays-ms")]
)
def test_a_training_on_warp_is_refused_without_a_gpu(capsys, flags):
    assert bench.main([*flags, "--quick"]) == 2
    assert "needs a GPU, and JAX has none here\n\nhint: " in capsys.readouterr().err


@pytest.mark.night
def test_walk_delays(run):
    """The policy that the pipeline ships, which needs no training, on one twin."""
    rows = {r["name"].removeprefix("walk_delays/shipped/10_ms/"): r["value"] for r in run("walk-delays")["rows"]}
    assert set(rows) == {"falls", "error_m_s", "error_rad_s", "judge_s"}
    assert rows["falls"] == 0
