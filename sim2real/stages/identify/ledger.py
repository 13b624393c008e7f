"""The ledger of an identification: its errors beside the bounds that were given before, and bounds on later errors."""

from collections.abc import Sequence
from dataclasses import replace

from sim2real.artifacts.identification import HeldOutPart, Identification
from sim2real.identify.fit import Fit
from sim2real.identify.problem.segments import beyond, ranges
from sim2real.identify.validation.verdict import positions
from sim2real.stages.estimation import growth, promises
from sim2real.stages.estimation.predicted_logs import in_blocks, predicted, stretches
from sim2real.stages.identify.inputs import Inputs


def with_promises(
    document: Identification, inputs: Inputs, fit: Fit, parts: Sequence[HeldOutPart]
) -> tuple[Identification, list[str]]:
    """Return the document with its ledger, bounds and ranges, and sentences about held-out data outside the ranges."""
    names, measured = [log.path.stem for log in inputs.logs], positions(inputs.model, inputs.units)
    # Take the ranges of the fitted segments, and those of each log's held-out segments.
    fitted = [s for s in inputs.windows if s.fitted]
    held_out = [[s for s in inputs.windows if s.recording == r and not s.fitted] for r in range(len(inputs.logs))]
    before, *later = (ranges(inputs.model, inputs.episodes, s, fit.windows.segment_s) for s in (fitted, *held_out))
    # Compare each error with its bound, then derive the bounds on later errors.
    stretch = [stretches(before, log, measured) for log in later]
    blocks = in_blocks(names[: inputs.fitted], parts)
    # Take the sizes of the motions, with which errors of many recordings may grow.
    of = lambda spans: growth.sizes(inputs.model, inputs.episodes, spans, fit.windows.segment_s)  # noqa: E731
    motions = {name: of([s for s in fitted if s.recording == r]) for r, name in enumerate(inputs.names)}
    recordings = predicted(names, inputs.fitted, parts, stretch, [of(spans) for spans in held_out])
    growths = promises.growths_of(parts, measured, motions)
    ledger = promises.ledger(document, parts, measured, recordings, motions, growths)
    document = replace(document, ranges=before, promises=ledger)
    document = replace(document, bounds=promises.bounds(document, recordings, blocks, growths))
    outside = dict.fromkeys(text for log in later for text in beyond(before, log))
    return document, [f"held-out data extrapolates: {text}" for text in outside]
