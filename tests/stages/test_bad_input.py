"""Bad input: each a clear error with a hint and its exit code, and no traceback."""

import json
from pathlib import Path

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


LOG = "the log of the finished run"


@pytest.mark.parametrize(
    ("code", "arguments", "word"),
    [
        *((errors.ERROR, [stage, "pendulum"], "no finished") for stage in ("identify", "train", "deploy")),
        (errors.ERROR, ["identify", "arm", "--log", LOG], "log of pipeline 'pendulum', not of 'arm'"),
        (errors.ERROR, ["identify", "pendulum", "--log", "none.mcap"], "there is no log"),
        (errors.ERROR, ["identify", "pendulum", "--log", "empty.mcap"], "cut"),
        (errors.ERROR, ["identify", "pendulum", "--log", "."], "session.mcap"),
        (errors.USAGE, ["identify", "pendulum", "--log", LOG, "--bounds", "gain", "30", "60"], "exclude its nominal"),
        (errors.USAGE, ["identify", "pendulum", "--log", LOG, "--bounds", "gian", "30", "60"], "Available: gain"),
        (errors.USAGE, ["identify", "pendulum", "--log", LOG, "--bounds", "gain", "30"], "expected 3 arguments"),
        (errors.USAGE, ["identify", "pendulum", "--log", LOG, "--bounds", "actuator_delay", "0", "1"], "--max-delay-s"),
        (errors.USAGE, ["identify", "pendulum", "--log", LOG, "--bounds", "gain", "5", "60",
                        "--bounds", "gravity", "200", "300"], "'gravity'"),
        (errors.USAGE, ["record", "pendulum", "--gate.limit", "nan"], ""),
        (errors.USAGE, ["record", "pendulum", "--gate.servo-watchdog-s", "0"], ""),
        (errors.USAGE, ["record", "pendulum", "--seed", "-1"], ""),
        (errors.USAGE, ["record", "pendulum", "--high-hz", "40"], ""),
        *((errors.USAGE, [command, "disk"], "sim2real import FILE --pipeline disk")
          for command in ("record", "train", "deploy", "run")),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_before_a_folder_is_made(fails, tmp_path, monkeypatch, log, code, arguments, word):
    monkeypatch.chdir(tmp_path)
    Path("empty.mcap").touch()
    given = [log if a == LOG else a for a in arguments]
    assert word in fails(code, *given, hint=False)
    assert [path.name for path in tmp_path.iterdir()] == ["empty.mcap"]


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


@pytest.mark.parametrize("port", ["/dev/no_such_port", "/dev/null"])
def test_ports_that_are_none(fails, tmp_path, port):
    assert port in fails(errors.HARDWARE_LOST, "record", "pendulum", "--port", port, "--runs", tmp_path)
    (manifest,) = tmp_path.glob("pendulum/*/record/manifest.json")
    assert json.loads(manifest.read_text())["exit_code"] == errors.HARDWARE_LOST


def test_damaged_parameters(fails, tmp_path, finished_run_dir):
    good = json.loads((finished_run_dir / "identify" / "parameters.json").read_text())
    path = tmp_path / "parameters.json"

    def damaged(text):
        path.write_text(text)
        return fails(errors.ERROR, "train", "pendulum", "--parameters", path, "--runs", tmp_path)

    assert f"format 2, this version reads {FORMAT}" in damaged(json.dumps({**good, "format": 2}))
    assert "of pipeline 'arm'" in damaged(json.dumps({**good, "pipeline": "arm"}))
    assert "damping" in damaged(
        json.dumps({**good, "parameters": [p for p in good["parameters"] if p["name"] != "damping"]})
    )
    rows = [{**p, "estimate": float("nan")} if p["name"] == "gain" else p for p in good["parameters"]]
    assert "is malformed" in damaged(json.dumps({**good, "parameters": rows}))
    assert "there is no timing.json beside it" in damaged(json.dumps(good))
    assert not (tmp_path / "pendulum").exists()
