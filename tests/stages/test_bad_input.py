"""Bad input: each a clear error with a hint and its exit code, and no traceback."""

import json

import pytest

from sim2real import cli, errors
from sim2real.artifacts.identification import FORMAT


@pytest.fixture
def log(finished_run_dir):
    """A recorded log of the pendulum."""
    return finished_run_dir / "record" / "session.mcap"


@pytest.fixture
def fails(capsys):
    """Call the command line and return what it said; it must fail in the documented way."""

    def call(code, *arguments, hint=True):
        capsys.readouterr()
        assert cli.main([str(a) for a in arguments]) == code
        said = capsys.readouterr().err
        assert "error: " in said
        assert "\n\nhint: " in said or not hint
        assert "raceback" not in said
        return said

    return call


@pytest.mark.parametrize("stage", ["identify", "train", "deploy"])
def test_missing_artifacts(fails, tmp_path, stage):
    said = fails(errors.ERROR, stage, "pendulum", "--runs", tmp_path / "none")
    assert "no finished" in said
    assert not (tmp_path / "none").exists()


def test_log_of_another_pipeline(fails, tmp_path, log):
    said = fails(errors.ERROR, "identify", "arm", "--log", log, "--runs", tmp_path / "runs")
    assert "log of pipeline 'pendulum', not of 'arm'" in said
    assert not (tmp_path / "runs").exists()


def test_files_that_are_no_logs(fails, tmp_path, log):
    whole = log.read_bytes()
    cut = tmp_path / "cut.mcap"
    for content, word in ((b"hello", "no MCAP"), (whole[:200], "cut before"), (whole[:4], "cut before"), (b"", "cut")):
        cut.write_bytes(content)
        assert word in fails(errors.ERROR, "identify", "pendulum", "--log", cut, "--runs", tmp_path)
    assert "there is no log" in fails(errors.ERROR, "identify", "pendulum", "--log", tmp_path / "none.mcap")
    assert "session.mcap" in fails(errors.ERROR, "identify", "pendulum", "--log", tmp_path, "--runs", tmp_path)
    assert not (tmp_path / "pendulum").exists()


def test_logs_that_are_too_short(fails, tmp_path, log):
    said = fails(errors.USAGE, "identify", "pendulum", "--log", log, "--horizon-s", "11", "--runs", tmp_path)
    assert "record for at least" in said
    short = tmp_path / "short.mcap"
    short.write_bytes(log.read_bytes()[: log.stat().st_size // 20])
    said = fails(errors.USAGE, "identify", "pendulum", "--log", short, "--runs", tmp_path)
    assert "is not whole" in said
    assert "segments" in said


@pytest.mark.night
def test_a_truncated_log_works_with_a_warning(tmp_path, log, capsys):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[: log.stat().st_size * 4 // 5])
    flags = ["--log", cut, "--generations", 0, "--refine-steps", 3, "--free-run-s", 0]
    flags += ["--folds", 0, "--runs", tmp_path]
    assert cli.main(["identify", "pendulum", *map(str, flags)]) == 0
    said = capsys.readouterr()
    assert "warning: the log" in said.err
    assert "is not whole" in said.err
    assert "round_trip_delay" in said.out


@pytest.mark.parametrize(
    ("flags", "word"),
    [
        (["gain", "30", "60"], "exclude its nominal value"),
        (["gian", "30", "60"], "Available: gain, gravity"),
        (["gain", "30"], "expected 3 arguments"),
        (["actuator_delay", "0", "0.2"], "--max-delay-s"),
    ],
)
def test_bounds(fails, finished_run_dir, flags, word):
    root = finished_run_dir.parent.parent
    assert word in fails(errors.USAGE, "identify", "pendulum", "--runs", root, "--bounds", *flags, hint=False)


def test_several_bounds(finished_run_dir, fails):
    root = finished_run_dir.parent.parent
    bounds = ["--bounds", "gain", "5", "60", "--bounds", "gravity", "200", "300"]
    assert "'gravity'" in fails(errors.USAGE, "identify", "pendulum", "--runs", root, *bounds)
    bounds = ["--bounds", "gain", "50", "60", "--bounds", "gravity", "100", "300"]
    assert "'gain'" in fails(errors.USAGE, "identify", "pendulum", "--runs", root, *bounds)


@pytest.mark.parametrize("port", ["/dev/no_such_port", "/dev/null"])
def test_ports_that_are_none(fails, tmp_path, port):
    assert port in fails(errors.HARDWARE_LOST, "record", "pendulum", "--port", port, "--runs", tmp_path)
    (manifest,) = tmp_path.glob("pendulum/*/record/manifest.json")
    assert json.loads(manifest.read_text())["exit_code"] == errors.HARDWARE_LOST


@pytest.mark.parametrize(
    "flags",
    [
        ["--gate.limit", "nan"],
        ["--gate.servo-watchdog-s", "0"],
        ["--seed", "-1"],
        ["--high-hz", "40"],
    ],
)
def test_limits_that_are_none(fails, tmp_path, flags):
    fails(errors.USAGE, "record", "pendulum", "--runs", tmp_path / "runs", *flags, hint=False)
    assert not (tmp_path / "runs").exists()


def test_damaged_parameters(fails, tmp_path, finished_run_dir):
    good = json.loads((finished_run_dir / "identify" / "parameters.json").read_text())
    path = tmp_path / "parameters.json"

    def damaged(text):
        path.write_text(text)
        return fails(errors.ERROR, "train", "pendulum", "--parameters", path, "--runs", tmp_path)

    for text in ("", "{", "[]", "{}", '{"parameters": 3, "pipeline": "pendulum", "log": {"path": "x"}}'):
        assert "is malformed" in damaged(text)
    assert f"format 2, this version reads {FORMAT}" in damaged(json.dumps({**good, "format": 2}))
    assert "of pipeline 'arm'" in damaged(json.dumps({**good, "pipeline": "arm"}))
    assert "damping" in damaged(
        json.dumps({**good, "parameters": [p for p in good["parameters"] if p["name"] != "damping"]})
    )
    rows = [{**p, "estimate": float("nan")} if p["name"] == "gain" else p for p in good["parameters"]]
    assert "is malformed" in damaged(json.dumps({**good, "parameters": rows}))
    assert "there is no timing.json beside it" in damaged(json.dumps(good))
    path.unlink()
    assert "cannot read" in fails(errors.ERROR, "train", "pendulum", "--parameters", tmp_path)
    assert not (tmp_path / "pendulum").exists()


@pytest.mark.parametrize("pipeline", ["disk", "so101_log", "xl330"])
@pytest.mark.parametrize("stage", ["record", "train", "deploy", "run"])
def test_robots_that_are_known_from_recordings_alone(fails, tmp_path, pipeline, stage):
    said = fails(errors.USAGE, stage, pipeline, "--runs", tmp_path / "runs")
    assert f"sim2real import FILE --pipeline {pipeline}" in said
    assert not (tmp_path / "runs").exists()
