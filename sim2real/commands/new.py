"""Write the files of a pipeline for a robot that was recorded."""

import re
from dataclasses import replace
from pathlib import Path

import msgspec

from sim2real.commands.config import NewConfig
from sim2real.errors import UsageError
from sim2real.log.importing.mapping import to_toml
from sim2real.robots.from_model.mjcf import joints_of, read_model
from sim2real.robots.from_model.mjcf_parameters import expand
from sim2real.robots.from_model.mjcf_robot import RobotConfig
from sim2real.stages.pipeline import from_model
from sim2real.stages.terminal.console import wrote

_COMMANDS = {
    "position": ("goal",),
    "velocity": ("goal_velocity",),
    "torque": ("torque",),
    "duty": ("duty",),
    "mit": ("goal", "goal_velocity", "torque", "kp", "kd"),
}
_INIT = '''"""{summary}."""

from dataclasses import replace

from sim2real.stages.pipeline.robot_flags import MODEL_IDENTIFY
from sim2real.stages.pipeline.pipeline import Pipeline

PIPELINE = Pipeline(
    name="{name}",
    summary="{summary}",
    package=__name__,
    # Every field of sim2real.stages.config.IdentifyConfig may stand here: how long segments are, which delays may be.
    identify=replace(MODEL_IDENTIFY, horizon_s={horizon_s:g}, max_delay_s={max_delay_s:g}),
)
'''
_ROBOT = '''"""The robot: robot.toml has the recorded joints, their drives, and the parameters to identify."""

from pathlib import Path

from sim2real.robots.from_model.mjcf_robot import ROBOT_FILE, MjcfRobot, RobotConfig

ROBOT = MjcfRobot(RobotConfig.load(Path(__file__).with_name(ROBOT_FILE)))
'''


def run(config: NewConfig) -> bool:
    """Write a pipeline's folder; with ``--like`` also calibrate, record and identify the robot on the port.

    Returns:
        False if the identification was not accepted.

    Raises:
        UsageError: When the name is none, the folder exists, or the model cannot be driven.
    """
    if config.like is not None:
        from sim2real.commands.new_like import run as run_like

        return run_like(config)
    # Check name, model and folder.
    if config.model is None or not re.fullmatch(r"[a-z]\w*", config.name):
        raise UsageError(
            f"new needs a name of small letters, digits and underscores, and a model, got {config.name!r} and "
            f"{str(config.model) if config.model else 'no model'}",
            hint="sim2real new go2 go2.xml --log run.csv",
        )
    folder = config.folder / config.name
    if folder.exists():
        raise UsageError(f"{folder} exists", hint="choose another name, or delete it")
    description, mapping = _described(config)
    # Refuse a robot that cannot run before a file is written.
    expand(description.terms, description.joints, description.driven(), read_model(description.model))
    if config.log is None:
        from_model.note_held(description)
    # Write the files of the pipeline.
    default = from_model.MODEL_IDENTIFY
    summary = f"recorded robot of {len(description.joints)} joints, identified from its model"
    texts = {
        "__init__.py": _INIT.format(
            name=config.name, summary=summary, horizon_s=default.horizon_s, max_delay_s=default.max_delay_s
        ),
        "robot.py": _ROBOT,
        **from_model.files_of(description),
        **({"import.toml": mapping} if mapping else {}),
    }
    folder.mkdir(parents=True)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
        wrote(folder / name)
    return True


def _described(config: NewConfig) -> tuple[RobotConfig, str]:
    """Return the robot's description, and the text of its mapping; without a log, by the flags alone."""
    # With a log, describe the robot by the log and its mapping.
    flags = replace(config.robot, mjcf=config.model)
    if config.log is not None:
        model_robot = from_model.from_flags(flags, [config.log])
        mapping = (
            ""
            if model_robot.mapping is None
            else to_toml(msgspec.structs.replace(model_robot.mapping, pipeline=config.name))
        )
        return model_robot.description, mapping
    # Without a log, describe it by the kind of drive.
    joints = flags.joints or joints_of(read_model(Path(str(config.model))))
    rate_hz, step_s = flags.rate_hz or RobotConfig.rate_hz, flags.step_s or RobotConfig.step_s
    commands, physical = _COMMANDS[config.drive], config.drive == "mit"
    return from_model.describe(flags, joints, commands, rate_hz, step_s, physical), ""
