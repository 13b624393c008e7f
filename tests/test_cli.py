"""The command line: what it says, where it says it, and the exit codes."""

import ast
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import pytest

from sim2real import cli, errors
from sim2real.artifacts import run as run_folder
from sim2real.artifacts.identification import Identification, Judgement
from sim2real.commands import flags, run, stages
from sim2real.commands.stages import module_of
from sim2real.graph.episode import StepRecord
from sim2real.log import McapRecorder
from sim2real.runtime.failure import named
from sim2real.stages.load import defaults_of
from sim2real.stages.validate.config import ValidateConfig

QUICK = {**os.environ, "PYTHONUNBUFFERED": "1"}


@pytest.fixture
def calls(monkeypatch, tmp_path):
    """Stand-ins for the four stages, in an empty working directory; returns the calls they got."""
    monkeypatch.chdir(tmp_path)
    seen = []

    def stand_in(stage):
        def run(pipeline, config, root, run_dir):
            seen.append((stage, config, run_dir))
            with run_folder.open_stage(root, pipeline.name, stage, config, run_dir=run_dir) as folder:
                folder.output("result", "result.txt").write_text(stage)
                if stage == "identify":
                    accepted = Identification(pipeline.name, (), Judgement("accepted", ()), ())
                    accepted.write(folder.output("parameters", "parameters.json"))
                folder.summary({"seed": config.seed})
            return folder.result

        module = ModuleType(module_of(stage))
        module.run = run
        return module

    # Stand-ins leave no artifacts.
    monkeypatch.setattr(stages, "write_report", lambda run_dir: None)
    monkeypatch.setattr(run, "conclude", lambda run_dir: None)
    monkeypatch.setattr(run, "main_figures", lambda done: {})
    for stage in run_folder.STAGES:
        monkeypatch.setitem(sys.modules, module_of(stage), stand_in(stage))
    return seen


def fail_with(monkeypatch, error):
    module = ModuleType("sim2real.stages.session.record")

    def run(*_):
        raise error

    module.run = run
    monkeypatch.setitem(sys.modules, "sim2real.stages.session.record", module)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["recrod"], "record, identify, train, deploy, run, report, info"),
        (["record", "no_such_robot"], "pendulum"),
        (["record", "pendulum", "--durations-s", "3"], "did you mean --duration-s?"),
        (["record", "pendulum", "--gate.limt", "3"], "--gate.limit?"),
        (["record", "pendulum", "--duration-s", "long"], "long"),
        (["record", "pendulum", "surplus"], "surplus"),
        (["info", "no_such_log.mcap"], "no_such_log.mcap"),
        (["validate", "--parameters", "run"], "write its value without --parameters"),
        (["validate", "--no-json", "--mjcf=robot.xml", "--log", "b.npz"], "unknown flag --mjcf. Available: --log,"),
        (["validate", "run"], "validate needs --log FILE"),
        (["play"], "hint: sim2real play go2"),
        (["import", "--bogus"], "--runs\n\nhint: `sim2real import --help-all` lists all flags"),
        (["import", "run.csv", "--rate-hz", "0"], "above 0"),
        (["record", "pendulum", "--duration-s", "0"], "see `sim2real record --help`"),
        (
            ["record", "pendulum", "--amplitude", "5"],
            "got 5.0\n\nhint: the limit stands in the robot's file: gate.limit",
        ),
        (["report", "no_such"], "Pipelines: "),
        (["report", "runs/no_such"], "hint: check the path"),
        (["report", "--rerun", "pendulum"], "sim2real report pendulum --rerun"),
    ],
)
def test_wrong_commands_exit_2_and_name_what_there_is(capsys, calls, arguments, named):
    assert cli.main(arguments) == errors.USAGE
    out, err = capsys.readouterr()
    assert err.startswith("error: ")
    assert "\n\nhint: " in err or named in err.splitlines()[0]
    assert named in err
    assert "----" not in err, "the parser prints its reason in a box"
    assert not out
    assert not calls


@pytest.mark.parametrize(
    ("kind", "code"),
    [
        (errors.Sim2RealError, 1),
        (errors.UsageError, 2),
        (errors.SafetyStop, 3),
        (errors.HardwareLost, 4),
        (errors.DeadlineExceeded, 5),
    ],
)
def test_errors_become_exit_codes(monkeypatch, capsys, kind, code):
    fail_with(monkeypatch, kind("it broke", hint="mend it"))
    assert cli.main(["record", "pendulum"]) == code
    assert capsys.readouterr() == ("", "error: it broke\n\nhint: mend it\n")


def noted():
    error = named(errors.HardwareLost("no answer", hint="check the cable"), "sensor", "step 12")
    error.add_note("then: OSError:\n disk full")
    return error


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (
            noted(),
            4,
            "error: no answer\n  node 'sensor', step 12\n  then: OSError: disk full\n\nhint: check the cable\n",
        ),
        (named(KeyError("x"), "agent", "step 3"), 1, "error: node 'agent' failed in its step 3: KeyError: 'x'\n"),
        (SystemExit(143), 143, "ended by SIGTERM\n"),
    ],
)
def test_notes_stand_between_message_and_hint_and_signals_are_named(monkeypatch, capsys, tmp_path, error, code, said):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    fail_with(monkeypatch, error)
    assert cli.main(["record", "pendulum"]) == code
    assert capsys.readouterr() == ("", said)


def test_debug_adds_the_traceback(monkeypatch, capsys):
    monkeypatch.setenv("SIM2REAL_DEBUG", "1")
    fail_with(monkeypatch, errors.SafetyStop("too fast"))
    assert cli.main(["record", "pendulum"]) == errors.SAFETY_STOP
    assert "Traceback" in capsys.readouterr().err


def test_unexpected_errors_name_the_saved_traceback(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    fail_with(monkeypatch, ZeroDivisionError("division\nby zero"))
    assert cli.main(["record", "pendulum"]) == errors.ERROR
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ZeroDivisionError: division by zero (traceback in ")
    (saved,) = tmp_path.glob("*.traceback.txt")
    assert str(saved) in line
    assert "Traceback" in saved.read_text()


def test_flags_reach_the_stage_and_the_result_goes_to_stdout(calls, capsys, tmp_path):
    arguments = ["--duration-s", "7", "--gate.limit", "2.5", "--no-strict-timing", "--runs", "elsewhere"]
    assert cli.main(["record", "pendulum", *arguments]) == 0
    ((stage, config, run_dir),) = calls
    assert (stage, config.duration_s, config.gate.limit, run_dir) == ("record", 7.0, 2.5, None)
    out, err = capsys.readouterr()
    (folder,) = (tmp_path / "elsewhere" / "pendulum").iterdir()
    assert f"wrote elsewhere/pendulum/{folder.name}/record/result.txt" in out
    assert "seed  0" in out
    assert not err


def test_a_flag_takes_all_logs_that_a_shell_finds(calls):
    logs = ["--log", "a.csv", "b.csv", "c.csv", "--hold-out", "d.csv", "e.csv", "--seed", "3"]
    assert cli.main(["identify", "pendulum", *logs]) == 0
    ((_, config, _),) = calls
    assert (config.log, config.hold_out, config.seed) == (("a.csv", "b.csv", "c.csv"), ("d.csv", "e.csv"), 3)
    scored = flags.parse(ValidateConfig(), ["run/parameters.json", "--log", "a.json", "b.json", "--json"], "validate")
    assert (scored.log, scored.parameters) == (("a.json", "b.json"), "run/parameters.json")


@pytest.mark.parametrize("all_flags", [False, True])
def test_help_shows_the_flags_that_a_user_sets_and_all_on_request(capsys, all_flags):
    assert cli.main(["run", "pendulum", "--help-all" if all_flags else "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert ("  --identify.population INT" in "\n".join(lines)) == all_flags
    assert len(lines) <= 90 or all_flags
    assert not {"(default: None)", "╭"} & set(lines)


def test_flags_without_a_block_stand_before_all_blocks(capsys):
    assert cli.main(["train", "pendulum", "--help"]) == 0
    shown = capsys.readouterr().out
    names = re.findall(r"^  --([\w.-]+)", shown, re.MULTILINE)
    assert {"model", "ppo.total-steps"} <= set(names)
    assert names == sorted(names, key=lambda name: "." in name)
    assert "\n\n\n" not in shown


def test_every_command_has_help_and_all_together_show_forty_flags(capsys):
    """A flag of a stage counts once, also where `run` has it with a prefix."""
    shown = set()
    for command in cli.COMMANDS:
        assert cli.main([command, "--help"]) == 0
        out = capsys.readouterr().out
        assert f"usage: sim2real {command}" in out
        names = re.findall(r"^  --([\w.-]+)", out, re.MULTILINE)
        shown |= {name.rpartition(".")[2] for name in names}
        if command == "export":
            assert [f for f in ("mjcf", "mjlab", "isaaclab", "json", "card", "policy") if f not in out] == []
    assert len(shown) <= 40, sorted(shown)


def test_a_range_replaces_one_of_the_pipeline_or_is_added_to_them(calls):
    ranges = ["--vary.range", "roughness", "0", "0.04", "--vary.range", "payload", "-2", "3"]
    assert cli.main(["train", "go2", *ranges]) == 0
    ((_, config, _),) = calls
    own = defaults_of("go2").train.vary.range
    assert config.vary.range == {**own, "payload": (-2.0, 3.0), "roughness": (0.0, 0.04)}
    assert own["payload"] == (-1.0, 2.5)


def test_run_is_all_four_stages_in_one_folder_with_one_seed(calls, capsys):
    assert cli.main(["run", "pendulum", "--seed", "3", "--train.seed", "9", "--record.duration-s", "5"]) == 0
    assert [stage for stage, *_ in calls] == list(run_folder.STAGES)
    assert [config.seed for _, config, _ in calls] == [3, 3, 9, 3]
    assert calls[0][1].duration_s == 5.0
    assert len({run_dir for *_, run_dir in calls[1:]}) == 1
    assert "record (1/4)" in capsys.readouterr().err
    calls.clear()
    assert cli.main(["demo", "--seed", "4"]) == 0
    assert [config.seed for _, config, _ in calls] == [4] * 4
    assert {config.port for stage, config, _ in calls if stage in ("record", "deploy")} == {"embedded"}


@pytest.mark.parametrize("finished", [("record",), ("record", "train")])
def test_resume_skips_what_is_finished_and_runs_everything_after_it(calls, capsys, finished):
    for name in finished:
        with run_folder.open_stage(Path("runs"), "pendulum", name, None, run_dir=Path("runs/pendulum/1")) as stage:
            pass
    assert cli.main(["run", "pendulum", "--resume", "1"]) == 0
    assert [name for name, *_ in calls] == ["identify", "train", "deploy"]
    assert {run_dir for *_, run_dir in calls} == {stage.run_dir}
    assert "record (1/4): finished before, skipped" in capsys.readouterr().err


def test_report_finds_the_newest_run(monkeypatch, calls, capsys, tmp_path):
    seen = []
    monkeypatch.setattr("sim2real.view.rerun_recording.view", lambda run_dir, save, *_: seen.append((run_dir, save)))
    monkeypatch.setattr("sim2real.view.page.report", lambda run_dir, out: run_dir / "report.html")
    cli.main(["record", "pendulum"])
    cli.main(["record", "pendulum"])
    capsys.readouterr()
    latest = max((tmp_path / "runs" / "pendulum").iterdir()).relative_to(tmp_path)
    assert cli.main(["report", "pendulum", "--rerun", "out.rrd"]) == 0
    assert cli.main(["report", str(latest / "record")]) == 0
    assert seen == [(latest, Path("out.rrd"))]
    assert capsys.readouterr().out == f"wrote out.rrd\nwrote {latest}/report.html\n"


def test_info_of_installation_pipeline_and_run(calls, capsys, tmp_path):
    assert cli.main(["info"]) == 0
    assert "pendulum" in capsys.readouterr().out
    cli.main(["record", "pendulum"])
    capsys.readouterr()
    assert cli.main(["info", "pendulum"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 10
    assert any(re.fullmatch(r"its stages +record finished, identify not finished, .*", line) for line in lines)
    (folder,) = (tmp_path / "runs" / "pendulum").iterdir()
    assert cli.main(["info", str(folder)]) == 0
    out = capsys.readouterr().out
    assert "finished" in out
    assert "result.txt" in out


@pytest.mark.parametrize("cut", [0, 60])
def test_info_of_a_log_whole_or_cut_and_names_that_do_not_control_the_terminal(capsys, tmp_path, cut):
    path, evil = tmp_path / "session.mcap", "sensor\x1b[2J"
    outputs = {node: {"th": 0.0} for node in ("sensor", evil)}
    log = McapRecorder(path, {"pipeline": "pendulum"}, {"parameters.json": b"{}"}, outputs, [])
    log.start(time.time_ns(), time.monotonic_ns())
    for k in range(4):
        for node in outputs:
            slot = 20_000 * k
            log.step(StepRecord(node, k, slot, slot, slot, -1, slot + 1000, 0), {"th": 0.1 * k})
    log.close()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) - cut])
    assert cli.main(["info", str(path)]) == 0
    assert cli.main(["info", "\x1b]0;mine\x07"]) == errors.USAGE
    out, err = capsys.readouterr()
    assert re.search("^ *.?/sensor/output +4", out, re.MULTILINE)
    assert "pipeline  pendulum" in out
    assert "attachments  parameters.json 2 B" in out
    assert "\x1b" not in out + err


@pytest.mark.parametrize(
    "change",
    [
        {"started": None},
        {"outputs": "x"},
        {"outputs": {"log": 3}},
        {"outputs": {"log": {"path": "../../../../etc/passwd", "sha256": "x"}}},
        {"outputs": {"log": {"path": "/etc/passwd", "sha256": "x"}}},
        {"inputs": []},
        {"pipeline": 3},
    ],
)
def test_manifests_that_are_none_are_passed_over(capsys, tmp_path, change):
    with run_folder.open_stage(tmp_path, "pendulum", "record", None) as stage:
        stage.output("log", "session.mcap").write_text("x")
    path = stage.folder / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    assert cli.main(["info", str(stage.run_dir)]) == errors.USAGE
    assert cli.main(["report", str(stage.run_dir)]) == errors.USAGE
    assert cli.main(["identify", "pendulum", "--runs", str(tmp_path)]) == errors.ERROR
    said = capsys.readouterr().err
    assert said.count("\nhint: ") == 3
    assert "raceback" not in said


def test_what_the_operating_system_refuses_is_said_in_words(capsys):
    assert cli.main(["info", "a" * 5000]) == errors.ERROR
    said = capsys.readouterr().err
    assert said.startswith("error: File name too long: ")
    assert "\n\nhint: " in said
    assert len(said) < 500


def test_info_of_something_else_is_an_error(capsys, tmp_path):
    path = tmp_path / "notes.mcap"
    path.write_text("no log at all, though its name says so")
    assert cli.main(["info", str(path)]) == errors.ERROR
    assert str(path) in capsys.readouterr().err


def test_nothing_heavy_is_imported_for_help():
    code = """
import sys, sim2real
from sim2real import cli
sim2real.__version__, dir(sim2real)
for line in ("--help", "record pendulum --help", "run pendulum --help-all", "new --help", "export --help",
             "import --help-all", "report --help", "play --help", "info"):
    cli.main(line.split())
print(sorted({"jax", "mujoco", "numpy", "matplotlib", "flax", "onnx", "rerun"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_public_names_are_listed_where_they_come_from():
    import sim2real

    stub = Path(sim2real.__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    typed = {
        (node.module, name.name)
        for node in ast.parse(stub).body
        if isinstance(node, ast.ImportFrom) and node.module != "sim2real"
        for name in node.names
    }
    assert typed == {(module, name) for name, module in sim2real._MODULE_OF_NAME.items()}
    assert set(sim2real.__all__) == set(sim2real._MODULE_OF_NAME)
    assert sim2real.Sim2RealError is errors.Sim2RealError
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        _ = sim2real.Nothing


def test_the_version_is_printed_and_signal_handlers_are_given_back(capsys):
    before = signal.getsignal(signal.SIGTERM)
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("sim2real ")
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_reader_that_has_enough_is_no_error():
    # 64 KiB fill the pipe: the command is still writing when its reader is gone.
    code = (
        "import sys; from sim2real import cli; cli._dispatch = lambda a: print('x' * 1_000_000); sys.exit(cli.main([]))"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.read(10)
    process.stdout.close()
    message = process.stderr.read()
    process.stderr.close()
    assert process.wait(30) == 1
    assert message == ""


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["run", "pendulum", "--train.hosts.found"], "only training can be divided among processes"),
        (["train", "pendulum", "--hosts.found", "--explain"], "explain does not train"),
    ],
)
def test_what_several_processes_cannot_do_is_refused(calls, capsys, arguments, said):
    assert cli.main(arguments) == 2
    assert said in capsys.readouterr().err
    assert not calls
