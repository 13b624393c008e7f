"""What is printed, and where."""

import pytest

from sim2real.stages import console


def test_table_aligns_numbers_right_and_text_left():
    text = console.table([["mass", 0.123456, True], ["inertia", 12, False]], ["name", "value", "ok"])
    assert text.splitlines() == [
        "name      value  ok",
        "-------  ------  ---",
        "mass     0.1235  yes",
        "inertia      12  no",
    ]


def test_table_fills_gaps():
    assert console.table([["a", None], ["long", 2.0], ["b"]]) == "a     -\nlong  2\nb"
    assert console.table([], ["x", "y"]) == "x  y\n-  -"
    assert console.table([]) == ""


def test_pairs():
    assert (
        console.pairs({"rmse_rad": 0.5, "bounds": {}, "delays": [0.25, 1]})
        == "rmse_rad  0.5\nbounds    -\ndelays    0.25, 1"
    )


def test_talk_goes_to_stderr_and_results_to_stdout(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    console.note("hello")
    console.wrote(tmp_path / "x" / "y")
    console.wrote("/elsewhere/z")
    assert capsys.readouterr() == ("wrote x/y\nwrote /elsewhere/z\n", "hello\n")


@pytest.mark.parametrize("always", [False, True])
def test_progress_is_silent_without_a_terminal_unless_asked(capsys, always):
    with console.progress(3, "train", always=always) as bar:
        bar.update()
    out, err = capsys.readouterr()
    assert not out
    assert ("train" in err) is always
