"""What validate simulates: the models of an identification, and later logs in segments."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.errors import UsageError
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span, beyond, ranges
from sim2real.identify.validation.verdict import Position
from sim2real.robots.contract import RecordedRobot
from sim2real.stages.estimation import growth, held_out_parts
from sim2real.stages.estimation.predicted_logs import Predicted, stretches
from sim2real.stages.estimation.segment_split import reach
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.pipeline.pipeline import Pipeline


def models_of(
    identification: Identification, pipeline: Pipeline
) -> tuple[RecordedRobot, IdentifiableModel, IdentifyConfig, dict[str, dict[str, float]]]:
    """Return robot, model and configuration of an identification, and the values of the models that predict.

    Raises:
        UsageError: The identification lacks parameters of the model, or each recording has its own.
    """
    robot = held_out_parts.having(pipeline.load(), [p.name for p in identification.parameters])
    fitting = replace(pipeline.identify, settle_s=identification.settle_s)
    model = robot.identifiable(fitting.max_delay_s)
    if varying := [p.name for p in model.parameters if p.free and p.per_recording]:
        raise UsageError(f"{', '.join(varying)} differ from recording to recording: a new log has no estimates of them")
    estimates = {p.name: p.estimate for p in identification.parameters}
    if lacking := [p.name for p in model.parameters if p.name not in estimates]:
        raise UsageError(f"the parameters lack {', '.join(lacking)}", hint="they are of another state of the robot")
    identified = {p.name: estimates[p.name] for p in model.parameters}
    return robot, model, fitting, {"identified": identified, "nominal": {p.name: p.nominal for p in model.parameters}}


def later_logs(
    model: IdentifiableModel, logs: Sequence[Recording], config: IdentifyConfig, horizon_s: float, once: bool = False
) -> Problem:
    """Return logs in segments without a fitted one; ``once``: one segment a log."""
    length_s = config.settle_s + horizon_s
    spans = []
    for r, log in enumerate(logs):
        begin, end = reach(log.episode, config)
        begins = np.arange(begin, end - length_s + 1e-6, length_s)
        spans += [Span(r, float(b), False) for b in (begins[:1] if once else begins)]
    return Problem(model, [log.episode for log in logs], spans, length_s, config)


def predicted_logs(
    identification: Identification, logs: Sequence[Recording], windows: Problem, measured: Sequence[Position]
) -> tuple[list[Predicted], list[str]]:
    """Return the logs with the factors of their bounds, and sentences about signals outside the fitted range."""
    predicted, sentences = [], []
    for r, log in enumerate(logs):
        spans = [s for s in windows.spans if s.recording == r]
        these = windows.model, [log.episode for log in logs], spans, windows.segment_s
        later = ranges(*these)
        stretch = stretches(identification.ranges, later, measured)
        predicted.append(Predicted(log.path.name, True, stretch, growth.sizes(*these)))
        sentences += [f"{log.path.name}: {sentence}" for sentence in beyond(identification.ranges, later)]
    return predicted, sentences
