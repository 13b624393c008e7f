"""The way out of a bound: a command that the parser takes as it is printed."""

import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from sim2real.commands import flags
from sim2real.commands.stages import StageFlags
from sim2real.stages.load import defaults_of, load_robot, robot_of
from sim2real.stages.shared.identification import command, continuing

ARM = load_robot("arm")


def parsed(text):
    """Return what the command line makes of a printed command: the pipeline, and its flags."""
    program, stage, pipeline, *rest = shlex.split(text)
    assert (program, stage) == ("sim2real", "identify")
    return pipeline, flags.parse(StageFlags(ARM.defaults.identify), rest, "sim2real identify")


@pytest.mark.parametrize(
    ("new", "bounds", "fix", "max_delay_s"),
    [
        ("--bounds gain 1 16", {"gain": (1.0, 16.0), "mass": (0.1, 0.4000000123)}, {"friction": 0.5}, 0.05),
        ("--bounds mass -3 1", {"gain": (1.0, 4.0), "mass": (-3.0, 1.0)}, {"friction": 0.5}, 0.05),
        ("--fix gain 0", {"mass": (0.1, 0.4000000123)}, {"gain": 0.0, "friction": 0.5}, 0.05),
        ("--max-delay-s 0.12", {"gain": (1.0, 4.0), "mass": (0.1, 0.4000000123)}, {"friction": 0.5}, 0.12),
    ],
)
def test_what_was_asked_before_is_asked_again_with_what_is_new(new, bounds, fix, max_delay_s):
    before = replace(
        ARM.defaults.identify,
        log=("my log.mcap", "b.mcap"),
        hold_out=("c.mcap",),
        bounds={"gain": (1.0, 4.0), "mass": (0.1, 0.4000000123)},
        fix={"friction": 0.5},
        generations=7,
        horizon_s=2.5,
        initial_state="rest",
        max_delay_s=0.05,
    )
    pipeline, asked = parsed(command(ARM, before, Path("elsewhere"), new))
    assert (pipeline, asked.runs) == ("arm", Path("elsewhere"))
    assert asked.config == replace(before, bounds=bounds, fix=fix, max_delay_s=max_delay_s)


def test_a_robot_of_python_alone_gets_no_command_that_does_not_find_it():
    own = robot_of(type("Spare", (type(ARM),), {})())
    said = continuing(own, defaults_of(own).identify, Path("runs"), Path("runs/my robot/partial.json"))
    call = "sim2real.identify(robot, recording, ...)"
    assert said.startswith(f"{call} with the settings --begin 'runs/my robot/partial.json'")
    assert command(own, defaults_of(own).identify, Path("runs")) == call
