"""`sim2real import`: files in, logs out."""

from pathlib import Path

import foreign_files
import numpy as np
import pytest

from sim2real import cli
from sim2real.artifacts.run import newest
from sim2real.log import read_log
from sim2real.view.sections import record_banner
from sim2real.view.signals import Signals
from sim2real.view.timing import timing_blocks, timing_tiles


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """A working directory with a pipeline 'rig' that has a mapping, and two files to import."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pipelines" / "rig").mkdir(parents=True)
    (tmp_path / "pipelines" / "rig" / "__init__.py").write_text('"""A rig."""\n')
    (tmp_path / "pipelines" / "rig" / "import.toml").write_text(foreign_files.TOML)
    (tmp_path / "out.toml").write_text(foreign_files.TOML.replace("rig", "../../../out"))
    for name in ("one.npz", "two.npz"):
        foreign_files.npz(tmp_path / name)
    return tmp_path


def test_each_file_becomes_a_run_with_the_pipelines_mapping(workplace, capsys):
    assert cli.main(["import", "one.npz", "two.npz", "--pipeline", "rig"]) == 0
    out, err = capsys.readouterr()
    assert not err
    assert out.count("wrote runs/rig/") == 2
    assert "stamps     actuator generated, sensor recorded" in out
    stage = newest(Path("runs"), "rig", "record")
    assert stage.finished
    assert stage.manifest.summary["samples"] == {"actuator": 50, "sensor": 50}
    assert stage.manifest.inputs["source"].path == "../../../two.npz"
    assert stage.manifest.inputs["mapping"].path.endswith("import.toml")
    episode = read_log(stage.output("log"))
    assert episode.metadata["pipeline"] == "rig"
    np.testing.assert_array_equal(episode.steps["sensor"].start, foreign_files.STAMPS_US)


def test_the_page_of_an_imported_log_claims_nothing_that_was_not_measured(workplace):
    assert cli.main(["import", "one.npz", "--pipeline", "rig", "--out", "log.mcap"]) == 0
    episode = read_log("log.mcap")
    assert set(episode.metadata["log"]["session_end"]) == {"status", "exit_code"}
    assert list(timing_tiles([episode])) == []
    assert timing_blocks(episode, "record") == []
    banner = record_banner(Signals(episode, [], [], {}))
    assert (banner.tone, "suspicious" in str(banner.reasons)) == ("good", False)


def test_a_mapping_of_ones_own_a_range_and_a_name_for_the_log(workplace, capsys):
    (workplace / "one.npz").rename("one.dat")
    (workplace / "map.toml").write_text(foreign_files.TOML.replace("rig", "arm"))
    flags = ["--mapping", "map.toml", "--samples", "10:20", "--out", "log.mcap"]
    assert cli.main(["import", *flags, "one.dat"]) == 0
    assert "wrote log.mcap" in capsys.readouterr().out
    assert not Path("runs").exists()
    assert len(read_log("log.mcap").steps["sensor"]) == 10
    assert cli.main(["info", "log.mcap"]) == 0
    assert 'stamps  {"actuator": "generated", "sensor": "recorded"}' in capsys.readouterr().out.replace("   ", " ")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([], "import needs FILE"),
        (["one.npz"], "write a mapping"),
        (["one.npz", "--pipeline", "no_such_robot"], "no_such_robot"),
        (["one.npz", "--pipeline", "pendulum"], "hinge"),
        (["one.npz", "--mapping", "none.toml"], "none.toml"),
        (["none.npz", "--pipeline", "rig"], "none.npz"),
        (["one.npz", "--unit", "furlongs"], "counts:N"),
        (["one.npz", "--episode", "3"], "no episodes"),
        (["one.npz", "--pipeline", "rig", "--samples", "10"], "A:B"),
        (["one.npz", "--pipeline", "rig", "--samples", "10:99"], "0:50"),
        (["one.npz", "two.npz", "--pipeline", "rig", "--out", "log.mcap"], "one by one"),
        (["one.npz", "--mapping", "out.toml"], "no name for a pipeline"),  # it would lead out of the folder of runs
    ],
)
def test_wrong_commands_exit_2_and_leave_no_run(workplace, capsys, arguments, named):
    assert cli.main(["import", *arguments]) == 2
    out, err = capsys.readouterr()
    assert err.startswith("error: ")
    assert "\n\nhint: " in err
    assert named in err
    assert not out
    assert not Path("runs").exists()
