"""Tables, JSON and arrays as other people write them: each row is a file, and beside it what it holds."""

import json
import math

import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.log.importing.files.foreign import open_foreign
from sim2real.log.importing.importer import import_opened
from sim2real.log.importing.proposal import propose
from sim2real.log.importing.quantities import ImportHints
from sim2real.log.importing.signal_names import meaning

BEGIN_S = 1_714_564_800  # 2024-05-01 12:00:00 UTC
ROWS = "0.0,1.5,2\n0.1,2.5,3\n"
T, Q, GOAL = [0.0, 0.1], [1.5, 2.5], [2, 3]


def opened(tmp_path, text, name="x.csv"):
    (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return open_foreign(tmp_path / name)


def all_signals(tmp_path, text):
    file = opened(tmp_path, text)
    return [file.signal(key) for key in file.keys]


@pytest.mark.parametrize(
    "text",
    [
        "t,q,goal\n" + ROWS,
        "\ufefft,q,goal\r\n" + ROWS.replace("\n", "\r\n"),
        ("t,q,goal\n" + ROWS).encode("utf-16"),
        "# recorder 1.2, unit: rad\n\nt,q,goal\n" + ROWS,
        "t,q,goal\n# warm\n0.0,1.5,2\n\n# cold\n0.1,2.5,3\n# end, of, it\n",
        "# t,q,goal\n" + ROWS,  # as numpy.savetxt writes it
        "# made by me\n#t, q, goal\n" + ROWS,
        "% t,q,goal\n" + ROWS,
        "// robot\nt,q,goal\n" + ROWS,
        "t;q;goal\n" + ROWS.replace(",", ";"),
        "t;q;goal\n" + ROWS.replace(",", ";").replace(".", ","),
        "t\tq\tgoal\n" + ROWS.replace(",", "\t").replace(".", ","),
        "sep=;\nt;q;goal\n" + ROWS.replace(",", ";").replace(".", ","),
        "t|q|goal\n" + ROWS.replace(",", "|"),
        "t q goal\n" + ROWS.replace(",", " "),
        "  t   q   goal\n  0.0  1.5   2\n  0.1  2.5   3 \n",
        "t,q,goal\n" + ROWS.replace("\n", ",\n"),
        "t,q,goal,\n" + ROWS.replace("\n", ",\n"),
        't,"q","goal"\n"0.0","1.5","2"\n0.1,2.5,3\n',
    ],
)
def test_forms_of_one_table(tmp_path, text):
    file = opened(tmp_path, text)
    assert list(file.keys) == ["t", "q", "goal"]
    for name, values in (("t", T), ("q", Q), ("goal", GOAL)):
        np.testing.assert_array_equal(file.signal(name), values)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("t,q\n0,1,0,5\n", r"line 2 .* 4 cells, the first has 2.*decimal commas need semicolons"),
        ('t,q\n0,"0,5"\n', r"line 2 .*'q' holds '0,5', no number.*decimal commas need semicolons"),
        ("t;q\n0,5;1.5\n", r"two ways: line 2 '0,5' with a comma, line 2 '1.5' with a point"),
        ("t;q\n0,5;1\n1.000,5;2\n", r"line 3 .*'1.000,5', no number"),
        ("# note\nt,q\n0,1\n# note\n1,off\n", r"line 5 .*column 'q' holds 'off', no number"),
        ("t,q\n0,1\n1\n", r"line 3 .* 1 cells, the first has 2"),
        ("0,1\n1,2\n", "holds numbers, not names"),
        ("# a,b,c\n0,1\n1,2\n", "holds numbers, not names"),
        ("# only\n# comments\n", "is empty"),
        ("t,t\n0,1\n", "more than one column 't'"),
        ("time,q\n2024-05-01 12:00:00,1\nlater,2\n", r"line 3 .*'later' is no date"),
        ("time,q\n2024-05-01 12:00:00,1\n17.5,2\n", r"line 3 .*'17.5' is no date"),
        ("time,q\n01.05.2024 12:00:00,1\n", r"line 2 .*'01.05.2024 12:00:00', no number.*write dates as"),
        (",".join(f"c{i}" for i in range(10_001)) + "\n", "has 10001 signals; at most 10000"),
        ("t,q\ns,rad\n0,1\n1,2\n", r"line 2 .* holds words below the names .*: s, rad.*delete the line"),
        ("t,q,\n# units\ns,rad,\n0,1,\n", r"line 3 .* holds words below the names"),
        ("t;q\n[s];[rad]\n0,5;1,5\n", r"line 2 .* holds words below the names"),
        ("t,q,phase\n,rad,-\n0,1,warm\n", r"line 2 .* holds words below the names"),
        ("t q\ns rad\n0 1\n", r"line 2 .* holds words below the names"),
        ("t,q\n0,1\nt,q\n0,1\n", r"line 3 .* repeats the names .*: two recordings were joined.*cut the file there"),
        ("t,q,\n0,1,\n t , q ,\n", r"line 3 .* repeats the names"),
        ("t;q\n0,5;1\nt;q\n", r"line 3 .* repeats the names"),
        ("t,q\n0,[1 2]\n1,[1 b]\n", r"line 3 .*no list of numbers"),
        ("t,q\n0,[" + " ".join("1" * 1001) + "]\n", r"line 2 .*1001 numbers"),
    ],
)
def test_tables_that_are_refused_with_the_reason(tmp_path, text, named):
    with pytest.raises(UsageError, match=f"(?s){named}"):
        all_signals(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("t,q,phase\n0,1,warm\n1,2,cold\n", [1, 2]),
        ("t,q,phase\n,,warm\n1,2,cold\n", [math.nan, 2]),
        ("phase,q\nwarm,\ncold,2\n", [math.nan, 2]),
        ("t,q\nnull,null\n1,2\n", [math.nan, 2]),
        ("t,q\n2024-05-01 12:00:00,\n2024-05-01 12:00:01,2\n", [math.nan, 2]),
        ("t,q\n0,1\n", [1]),
        (",t,q\n0,0,1\n1,1,2\n", [1, 2]),  # as pandas writes it
    ],
)
def test_tables_with_words_that_are_no_units(tmp_path, text, values):
    np.testing.assert_array_equal(opened(tmp_path, text).signal("q"), values)


def test_a_table_that_is_no_utf_8_is_read_as_latin_1_and_says_so(tmp_path):
    file = opened(tmp_path, "t,q_in_°\n0,1\n".encode("latin-1"))
    assert list(file.keys) == ["t", "q_in_°"]
    assert file.notes == ("x.csv is no UTF-8: it is read as latin-1",)
    file = opened(tmp_path, '{"t": [0, 1], "größe": [1, 2]}'.encode("latin-1"), "x.json")
    assert file.keys == ["t", "größe"]
    assert file.notes


@pytest.mark.parametrize(
    ("name", "texts", "values"),
    [
        (
            "time",
            ["2024-05-01T12:00:00.25", "2024-05-01T12:00:00.5"],
            [(BEGIN_S * 4 + k) * 250_000_000 for k in (1, 2)],
        ),
        (
            "time",
            ["2024-05-01 12:00:00,25", "2024-05-01 12:00:00,5"],
            [(BEGIN_S * 4 + k) * 250_000_000 for k in (1, 2)],
        ),
        ("stamp", ["2024-05-01T12:00:00Z", "2024-05-01T14:00:01+02:00"], [BEGIN_S * 10**9, (BEGIN_S + 1) * 10**9]),
        ("t", ["2024-05-01T12:00:00.123456789Z", "2024-05-01T12:00Z"], [BEGIN_S * 10**9 + 123456789, BEGIN_S * 10**9]),
        ("time_s", ["2024-05-01 12:00:00", "2024-05-01 12:00:01"], [BEGIN_S, BEGIN_S + 1]),
        ("time_ms", ["2024-05-01 12:00:00", "2024-05-01 12:00:01"], [BEGIN_S * 1000, BEGIN_S * 1000 + 1000]),
        ("clock", ["23:59:59.5", "9:00:00"], [86399.5, 32400]),
    ],
)
@pytest.mark.parametrize("suffix", ["csv", "json", "npz"])
def test_dates_are_stamps(tmp_path, name, texts, values, suffix):
    if suffix == "csv":
        file = opened(tmp_path, f"{name};q\n{texts[0]};1\n{texts[1]};2\n")
    elif suffix == "json":
        file = opened(tmp_path, json.dumps({name: texts}), "x.json")
    else:
        np.savez(tmp_path / "x.npz", **{name: np.array(texts), "q": np.zeros(2)})
        file = open_foreign(tmp_path / "x.npz")
    np.testing.assert_array_equal(file.signal(name), values)


def test_dates_of_numpy_are_stamps(tmp_path):
    stamps = np.datetime64("2024-05-01T12:00:00") + np.arange(3) * np.timedelta64(20, "ms")
    np.savez(tmp_path / "x.npz", t=stamps, q=np.zeros(3))
    file = open_foreign(tmp_path / "x.npz")
    assert file.keys == ["t", "q"]
    np.testing.assert_array_equal(file.signal("t"), BEGIN_S * 10**9 + 20_000_000 * np.arange(3))


COUNT = 400
TIME = np.arange(COUNT) * 0.005


def following(stamps):
    """Return a table of a joint that follows its goal 20 ms later, with these stamps."""
    tones = lambda t: sum(0.2 * math.sin(6.3 * w * t + w) for w in (0.7, 1.9, 3.1))  # noqa: E731
    lines = [
        f"{stamp};{tones(t):.6f};{tones(t - 0.02) + 1e-4 * math.sin(1e4 * t):.6f}"
        for stamp, t in zip(stamps, TIME.tolist(), strict=True)
    ]
    return "t;goal_rad;q_rad\n" + "\n".join(lines)


def test_a_table_with_dates_is_imported_at_its_time(tmp_path):
    stamps = [f"2024-05-01T12:00:{t:09.6f}" for t in TIME.tolist()]
    file = opened(tmp_path, following(stamps))
    episode = import_opened(file, propose(file, ImportHints("rig")).mapping)
    np.testing.assert_array_equal(episode.steps["sensor"].start, 5000 * np.arange(COUNT))
    assert episode.metadata["source"]["time_zero_us"] == BEGIN_S * 10**6


@pytest.mark.parametrize("form", ["{:02.0f}.05.2024 12:00:{:09.6f}", "05/{:02.0f}/2024 12:00:{:09.6f}"])
def test_dates_in_another_form_are_refused_by_their_line(tmp_path, form):
    file = opened(tmp_path, following([form.format(1, t) for t in TIME.tolist()]))
    with pytest.raises(UsageError, match=r"(?s)line 2 of .*column 't' holds .*2024.*write dates as 2024-05-01T12:00"):
        propose(file, ImportHints("rig"))


@pytest.mark.parametrize("tick_s", [0.01, 0.1, 1.0])
def test_a_clock_that_is_coarser_than_the_samples_is_named(tmp_path, tick_s):
    file = opened(tmp_path, following([f"{t // tick_s * tick_s:.3f}" for t in (TIME + 1e-9).tolist()]))
    with pytest.raises(UsageError, match=r"(?s)'t' .* repeat the one before in \d+% of 400 rows.*--rate-hz"):
        propose(file, ImportHints("rig"))
    found = propose(file, ImportHints("rig", rate_hz=200.0))
    episode = import_opened(file, found.mapping)
    np.testing.assert_array_equal(episode.steps["sensor"].start, 5000 * np.arange(COUNT))
    assert episode.metadata["stamps"]["sensor"] == "generated"


@pytest.mark.parametrize(
    ("name", "side", "quantity"),
    [
        ("/arm/controller_state.reference.positions", "command", "position"),
        ("/arm/controller_state.feedback.positions", "measured", "position"),
        ("/arm/controller_state.error.positions", "measured", "error"),
        ("/arm/state.desired.positions", "command", "position"),
        ("/follow/_action/feedback.feedback.actual.positions", "measured", "position"),
        ("/follow/_action/feedback.feedback.desired.positions", "command", "position"),
        ("/arm/controller_state/reference/positions[0]", "command", "position"),  # as PlotJuggler exports it
        ("/target_joint_states.position", "command", "position"),
        ("joint_state_desired", "command", ""),
        ("state.cmd_pos", "command", "position"),
        ("observation.state", "measured", ""),
        ("/joint_states.position", "measured", "position"),
        ("/cmd.position", "command", "position"),
        ("cmd_deg/FL_hip", "command", ""),
        ("position_error", "", "error"),
    ],
)
def test_words_of_the_field_count_before_those_of_the_topic(name, side, quantity):
    found = meaning(name)
    assert (found.side, found.quantity) == (side, quantity)
