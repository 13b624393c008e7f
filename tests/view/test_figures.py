"""The figures as data: their lines, texts and colours; one of them is drawn, and is well-formed."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.image import AxesImage
from matplotlib.text import Text
from sketches import sketched

from sim2real.artifacts.bundle import History
from sim2real.artifacts.deployment import Deployment
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run import finished_stages
from sim2real.view import identification, sections, style, timing
from sim2real.view.signals import ComparedSeries, Series, pairs_of, signals_of, simulated_series

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def artifacts(finished_run):
    return finished_stages(finished_run)


@pytest.fixture(scope="module")
def found(artifacts):
    return Identification.load(artifacts["identify"].folder)


@pytest.fixture(scope="module")
def log(artifacts):
    return signals_of(Recording.load(artifacts["record"].folder))


@pytest.fixture(scope="module")
def calls(artifacts, found, log):
    """Every figure there is, as a function and its arguments, by name."""
    deployed = Deployment.load(artifacts["deploy"].folder)
    episode, simulation = signals_of(deployed.recordings[1]), simulated_series(deployed.simulated[1])
    pairs = pairs_of(episode, simulation, {})
    training = History.load(artifacts["train"].folder)
    return {
        "record": (sections.recording_svg, log),
        "free": (identification.free_runs_svg, found),
        "training": (sections.training_svg, training),
        "deployment": (sections.deployment_svg, pairs, episode.units, 1),
        "difference": (svg_of(sections.largest_difference), [pairs], ["th"], episode.units),
        "worst": (svg_of(identification.worst_figure), found),
        "schedule": (timing.schedule, log.episode),
    }


def svg_of(draw):
    """Return a function that draws the figure of a block."""
    return lambda *arguments: draw(*arguments).svg


def figure_of(draw, *arguments):
    """Return the one figure that a function of the room makes."""
    with sketched() as made:
        draw(*arguments, "name")
    (figure,) = made
    return figure


@pytest.fixture(scope="module")
def drawn(calls):
    """Every figure as data, by name."""
    return {name: figure_of(*call) for name, call in calls.items()}


@pytest.fixture(scope="module")
def picture(calls):
    """The one figure that is drawn: it has lines, bars, hatching, arrows, a legend and a node's own colour."""
    draw, *arguments = calls["schedule"]
    return draw(*arguments, "schedule")


def lines_of(axes):
    """Return the lines of axes by colour and dash, ``(x, y)`` each; lines of no points stand in legends."""
    return {(to_hex(line.get_color()), line.get_linestyle()): line.get_data() for line in axes.lines}


def test_a_figure_is_one_well_formed_element_with_a_label(picture):
    root = ET.fromstring(picture)
    assert root.tag == f"{SVG}svg"
    assert root.get("role") == "img"
    assert root.get("aria-label") == "An excerpt of the schedule: when each node waited and computed, and its messages"
    assert "<metadata" not in picture


@pytest.mark.night
def test_every_figure_has_a_label_and_no_pixels(calls, drawn):
    for name, (draw, *arguments) in calls.items():
        with sketched():
            assert ET.fromstring(draw(*arguments, name)).get("aria-label"), name
        artists = drawn[name].findobj()
        assert not [a for a in artists if isinstance(a, AxesImage) or a.get_rasterized()], f"{name} holds pixels"


def test_ids_differ_between_the_figures_of_a_page(drawn):
    svgs = [style.to_svg(drawn["training"], name, name) for name in ("one", "two")]
    ids = [element.get("id") for svg in svgs for element in ET.fromstring(svg).iter() if element.get("id")]
    assert len(ids) == len(set(ids)) > 10


def test_measured_and_predicted_are_drawn_as_they_are(drawn, found):
    lines = lines_of(drawn["free"].axes[0])
    for color, model in ((style.INK, "measured"), (style.BLUE, "identified")):
        ((_, dash),) = [look for look in lines if look[0] == color]
        t_s, values = lines[color, dash]
        np.testing.assert_allclose(t_s, found.free["t"])
        np.testing.assert_allclose(values, found.free[f"th_{model}"])


def test_a_recording_is_drawn_with_its_truth_and_its_command(drawn, log):
    rows = {axes.get_ylabel(): lines_of(axes) for axes in drawn["record"].axes if axes.get_ylabel()}
    th, true = (next(s for s in log.measured if s.name == "th"), log.truth["th"])
    np.testing.assert_array_equal(rows["th [rad]"][style.INK, "-"], (th.t_s, th.values))
    ((_, dash),) = [look for look in rows["th [rad]"] if look[0] == style.GREEN]
    np.testing.assert_array_equal(rows["th [rad]"][style.GREEN, dash], (true.t_s, true.values))
    assert 0 <= true.t_s[0] < 0.006, "on the clock of the log, and cut to it"
    assert true.t_s[-1] <= log.episode.duration_s
    np.testing.assert_allclose(true.values, np.sin(true.t_s + 0.012), atol=1e-9)
    ((_, sent),) = rows["actuator.action [V]"].items()
    np.testing.assert_allclose(sent[1], np.sin(3 * 0.02 * np.arange(len(sent[1]))), atol=1e-6)


def test_text_is_never_parsed_as_mathematics(drawn, picture):
    for name, figure in drawn.items():
        assert not [t for t in figure.findobj(Text) if t.get_parse_math()], name
    assert "late wake-up" in ["".join(t.itertext()) for t in ET.fromstring(picture).iter(f"{SVG}text")]


def test_a_sample_is_shown_when_it_was_taken_and_a_command_when_it_was_sent(log):
    th = next(s for s in log.measured if s.name == "th")
    action = next(s for s in log.last_command() if s.name == "action")
    assert action.source == "actuator"
    assert th.t_s[3] == pytest.approx(0.06)
    assert action.t_s[3] == pytest.approx(0.06 + 3 * 1050e-6 + 20e-6)


def test_the_second_with_the_largest_difference_is_given_with_its_root_mean_square():
    t_s = np.arange(400) / 100
    wave = np.where((t_s >= 1) & (t_s <= 2), 0.3 * np.sin(2 * np.pi * t_s), 0.0)
    robot, simulation = (Series("th", "sensor", t_s, np.cos(t_s) + off) for off in (wave, 0.0))
    block = sections.largest_difference([[ComparedSeries("th", robot, simulation)]], ["th"], {"th": "rad"}, "name")
    # A sine of 0.3 rad, over its period.
    assert "th in episode 0, from 1.0 s, root mean square 2" in block.caption
    assert float(block.caption.split()[-2]) == pytest.approx(300 / 2**0.5, rel=0.01)
