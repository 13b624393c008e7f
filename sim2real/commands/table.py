"""The commands by name, in the order of ``sim2real --help``: those of every robot, then the others."""

from sim2real.commands.command_kinds import Command, CommandGroup, ConfigCommand, FunctionCommand, PipelineStage

_BASELINES = (
    "Ends with code 1 if an error exceeds the expected one, a baseline predicts as well, or a log is not scored."
)

OTHERS = ("compare", "view", "demo", "play")
"""Commands that ``sim2real --help`` lists last: other views of a run, and examples."""
# fmt: off
COMMANDS: dict[str, Command] = {
    "record": PipelineStage("record the robot under an excitation", "record.RecordConfig"),
    "identify": FunctionCommand(
        "identify dynamics, delays and initial states from the log", "commands.pipeline_commands.identify"
    ),
    "train": PipelineStage("train a policy on the identified model with the robot's timing", "train.TrainConfig"),
    "deploy": PipelineStage("run the policy on the robot and compare with the simulation", "deploy.DeployConfig"),
    "run": FunctionCommand(
        "all four, one after the other; --resume RUN continues an interrupted run", "commands.run_commands.run"
    ),
    "report": FunctionCommand("write a run's report as one HTML page", "commands.run_commands.report"),
    "info": FunctionCommand("about the installation, a pipeline, a log or a run", "commands.run_commands.info"),
    "check": FunctionCommand(
        "predict which parameters a recording, or a planned one, can determine", "commands.pipeline_commands.check"
    ),
    "validate": ConfigCommand(
        "score an identification on a later log", "stages.validate.stage", "stages.validate.config.ValidateConfig",
        examples=("validate runs/NAME/TIME/identify --log b.mcap",), note=_BASELINES,
    ),
    "import": ConfigCommand(
        "convert files of other recorders into logs", "stages.import_logs.stage",
        "stages.import_logs.config.ImportConfig", examples=("import data.npz --mjcf robot.xml", "info LOG"),
    ),
    "new": ConfigCommand(
        "write the files of a pipeline for a robot that has a model", "commands.new", "commands.config.NewConfig",
        examples=("new go2 go2.xml --log run.csv", "new my_arm --like so101 --port /dev/ttyACM0"),
    ),
    "export": CommandGroup(
        "write the estimates for MuJoCo, mjlab, Isaac Lab or as JSON; or a policy for a machine with numpy alone",
        {
            "identified": ConfigCommand(
                "RUN|PIPELINE|FILE --to mjcf|mjlab|isaaclab|json|card",
                "commands.export.identified", "commands.config.ExportConfig",
                examples=(
                    "export identified pendulum --to json",
                    "export identified runs/arm/TIME --to mjcf --out arm.xml",
                    "export identified pendulum --to card",
                ),
            ),
            "policy": ConfigCommand(
                "RUN|PIPELINE|BUNDLE --to DIR", "commands.export.policy", "commands.config.ShipConfig",
                examples=("export policy pendulum --to policy",),
            ),
        },
    ),
    "compare": ConfigCommand(
        "parameters with intervals, errors and success of several runs side by side",
        "stages.compare", "stages.compare.CompareConfig",
        examples=("compare runs/NAME/MONDAY runs/NAME/FRIDAY",),
    ),
    "view": FunctionCommand("open a run in the Rerun viewer, or save a file for it", "commands.run_commands.view"),
    "demo": FunctionCommand("run on the embedded pendulum, with its defaults", "commands.run_commands.demo"),
    "play": ConfigCommand(
        "let a walking policy follow velocities on a twin: in a window, with keys, or into a picture",
        "commands.play", "commands.config.PlayConfig",
        examples=("play go2", "play go2 --command 0.5 0 0.4 --video walk.gif", "play go2 --window"),
    ),
}
# fmt: on
