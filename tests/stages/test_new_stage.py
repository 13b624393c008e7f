"""A new stage is a folder with three files and one row of the table of commands, as CONTRIBUTING.md shows it."""

import json
import re
from itertools import takewhile
from pathlib import Path

from sim2real import cli, stages
from sim2real.commands.command_kinds import PipelineStage

PAGE = Path(__file__).parents[2] / "CONTRIBUTING.md"


def test_the_stage_of_the_page_runs_from_three_files_and_a_row(tmp_path, monkeypatch, capsys):
    files = {}
    for part in PAGE.read_text().split("    # sim2real/stages/count/")[1:]:
        name, *lines = part.split("\n")
        files[name] = "\n".join(line[4:] for line in takewhile(lambda line: line[:4].strip() == "", lines))
    assert list(files) == ["config.py", "stage.py", "show.py"]
    folder = tmp_path / "installed" / "count"
    folder.mkdir(parents=True)
    for name, text in files.items():
        (folder / name).write_text(text)
    (row,) = re.findall(r'    "count": (PipelineStage\(.*\)),\n', PAGE.read_text())
    monkeypatch.setattr(stages, "__path__", [*stages.__path__, str(folder.parent)])
    monkeypatch.setitem(cli.COMMANDS, "count", eval(row, {"PipelineStage": PipelineStage}))
    monkeypatch.chdir(tmp_path)

    assert cli.main(["count", "pendulum", "--help"]) == 0
    assert "--up-to" in capsys.readouterr().out
    assert cli.main(["count", "pendulum", "--up-to", "4", "--cache", "off"]) == 0
    assert "sum" in capsys.readouterr().out
    (manifest,) = tmp_path.glob("runs/pendulum/*/count/manifest.json")
    assert json.loads(manifest.read_text())["summary"] == {"sum": 10}
