"""A run on few lines: what is held back, what is printed all the same, and what a failure prints."""

import re

import pytest

from sim2real import cli
from sim2real.stages.terminal import console
from sim2real.stages.terminal.console import brief


def test_details_are_held_back_and_warnings_are_not(capsys):
    with brief():
        print("a table")
        console.note("a detail")
        console.note("warning: late answers")
        console.note("press Enter", urgent=True)
        with console.progress(3, "search") as bar:
            bar.update()
            bar.set_postfix_str("loss 2")
            bar.set_description_str("refine")
    console.note("after")
    out, err = capsys.readouterr()
    assert out == ""
    assert re.fullmatch(r"  \.?\nwarning: late answers\n\npress Enter\n\.? 0 s\nafter\n", err)


def test_a_failure_prints_the_details(capsys):
    def fail():
        print("a table")
        console.note("a detail")
        raise RuntimeError("the motor is gone")

    with pytest.raises(RuntimeError), brief():
        fail()
    assert capsys.readouterr().err.endswith("\na table\na detail\n")
    console.note("printed again")
    assert capsys.readouterr().err == "printed again\n"


def test_each_second_prints_a_dot(capsys, monkeypatch):
    assert console._TICK_S == 1.0
    monkeypatch.setattr(console, "_TICK_S", 0.001)
    printed = ""
    with brief():
        while printed.count(".") < 3:
            printed += capsys.readouterr().err


@pytest.mark.night
@pytest.mark.parametrize("verbose", [False, pytest.param(True, marks=pytest.mark.night)])
def test_the_demo_prints_at_most_25_lines(verbose, monkeypatch, tmp_path, capsys, run_copy):
    """The stages' artifacts are those of a finished run; each stage prints 100 lines of details."""
    from sim2real.artifacts.run import finished
    from sim2real.commands import run

    def call_stage(stage, pipeline, config, root, run_dir, page=True):
        for i in range(100):
            console.note(f"{stage}: detail {i}")
            print(f"row {i} of {stage}")
        return finished(run_copy, stage)

    monkeypatch.setattr(run, "run_stage", call_stage)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["demo", *(["--verbose"] if verbose else [])]) == 0
    out, err = capsys.readouterr()
    lines = (out + err).splitlines()
    assert (len(lines) > 800) if verbose else (len(lines) <= 25)
    assert re.search(
        r"^(fine|re-train|re-identify|look at this joint|not judged): .*\. Open .*report\.html$", out, re.M
    )
    assert out.splitlines()[-1].endswith("report.html")
