"""What is printed and where: results, messages, progress; and a run on few lines."""

import re
import threading

import pytest

from sim2real import cli
from sim2real.stages.terminal import console
from sim2real.stages.terminal.console import brief


def test_progress_is_plain_lines_without_a_terminal(capsys, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    with console.progress(3, "train (compiling)") as bar:
        now[0] += 57.0
        bar.set_description_str("train")
        for _ in range(3):
            now[0] += 10.0
            bar.set_postfix_str("return -245")
            bar.update()
    with pytest.raises(KeyError), console.progress(None, "record"):
        raise KeyError
    out, err = capsys.readouterr()
    assert not out
    assert err.splitlines() == [
        "train (compiling): started",
        "train (compiling): finished after 57.0 s",
        "train: started",
        "train: 1 of 3, return -245, 10 s so far",
        "train: 2 of 3, return -245, 20 s so far",
        "train: 3 of 3, return -245, 30 s so far",
        "train: finished after 30.0 s (return -245)",
        "record: started",
        "record: ended after 0.0 s",
    ]


def test_the_time_goes_on_while_one_step_takes_long(capsys, monkeypatch):
    monkeypatch.setattr(console, "_TICK_S", 0.001)
    monkeypatch.setattr(console, "_LINES_S", (0.001, 0.002, 0.01))
    printed = ""
    with console.progress(None, "identify: errors"):
        while printed.count("s so far") < 3:
            printed += capsys.readouterr().err
    with brief():
        while printed.count(".") < 3:  # a dot for each second
            printed += capsys.readouterr().err
    assert printed.startswith("identify: errors: started\nidentify: errors: 0 s so far\n")
    before = threading.active_count()
    with pytest.raises(KeyError), console.progress(None, "record"):
        raise KeyError
    assert threading.active_count() == before


def test_what_a_terminal_would_obey_is_shown_instead(capsys):
    evil = "\x1b]0;mine\x07 \x9b2J \u202egnp.exe \ud800 ü\ttab"
    console.note(evil)
    console.wrote(f"/x/{evil}")
    print(console.table([[evil, "two\nlines"]], ["a", "b"]), console.pairs({evil: evil}))
    out, err = capsys.readouterr()
    for text in (out, err):
        assert not set("\x1b\x07\x9b\u202e\ud800") & set(text)
        assert "\\x1b]0;mine\\x07" in text
        assert "ü\ttab" in text
    assert "two\\nlines" in out


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


@pytest.mark.night
@pytest.mark.parametrize("verbose", [False, True])
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
