"""``identify`` and ``check``: for a pipeline, or with ``--mjcf`` for a robot that its model describes."""

import sys

from sim2real.commands import command_kinds
from sim2real.commands.command_kinds import EXIT_CODES, PipelineStage
from sim2real.errors import ERROR
from sim2real.runtime import compilation_cache

_IDENTIFY = PipelineStage("", "identify.IdentifyConfig")


def identify(command: str, arguments: list[str]) -> None:
    """``sim2real identify PIPELINE [FLAGS]``, or ``sim2real identify --mjcf ROBOT.xml --log FILE [FLAGS]``."""
    from sim2real.commands import model_flags

    if not model_flags.by_model(arguments):
        _IDENTIFY(command, arguments)
        return
    flags = model_flags.parse_identify(arguments, EXIT_CODES)
    compilation_cache.enable(flags.cache)
    from sim2real.stages.pipeline import from_model  # imports JAX

    pipeline = from_model.from_flags(flags.robot, flags.config.log)
    command_kinds.run_stage("identify", pipeline, flags.config, flags.runs, flags.run)


def check(command: str, arguments: list[str]) -> None:
    """``sim2real check PIPELINE [FLAGS]``, or ``sim2real check --mjcf ROBOT.xml --log FILE [FLAGS]``."""
    if not {"-h", "--help"} & set(arguments):
        compilation_cache.enable()
    from sim2real.commands import flags, model_flags
    from sim2real.stages.check.config import CheckConfig

    # The robot is a model file, or a pipeline.
    if model_flags.by_model(arguments):
        model = model_flags.parse_check(arguments, EXIT_CODES)
        from sim2real.stages.pipeline import from_model  # imports JAX

        pipeline, config = from_model.from_flags(model.robot, model.config.log), model.config.config()
    else:
        pipeline, rest = command_kinds.split_pipeline(command, arguments)
        prog = f"sim2real {command} {pipeline.name}"
        default = CheckConfig(record=pipeline.record)
        description = f"{command_kinds.summary_of(default)} Ends with code 1 if a parameter is not determined."
        examples = command_kinds.epilog(f"{prog} --log session.mcap", f"{prog} --plan --record.duration-s 60")
        config = flags.parse(default, rest, prog, description, examples)
    from sim2real.stages.check import stage as check_stage  # imports JAX

    if not check_stage.run(pipeline, config):
        sys.exit(ERROR)
