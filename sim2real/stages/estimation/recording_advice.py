"""Advice on a recording, in sentences, from the results of a check; and commands to identify again."""

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import fields
from itertools import pairwise
from pathlib import Path
from typing import Any

from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.pipeline.pipeline import Pipeline

_GOAL = 0.01
"""Standard error to reach, as a fraction of the nominal value."""
_SHORT_S = 12.0
_MOVING, _COVERED, _ONE_SIDED = 0.3, 0.5, 0.2


def recommend(result: Mapping[str, Any], identify: str, record: str) -> list[str]:
    """Return sentences: first the problems of the data, then the next step.

    Args:
        result: The result of ``check.judge``.
        identify: The command that identifies from this data.
        record: The command that records the planned excitation.
    """
    planned = result["source"] != "log"
    have_s = sum(r["sampling"]["duration_s"] for r in result["recordings"])
    texts = [f"only {have_s:.1f} s: too little to fit one part and check on another"] if have_s < _SHORT_S else []
    texts += [sentence for r in result["recordings"] for sentence in _about(r, len(result["recordings"]) > 1)]
    enough = _enough(result)
    if not result["determined"]:
        names = ", ".join(dict.fromkeys(n for group in result["undetermined"] for n in group))
        texts.append(f"do not identify yet: some of {names} would be guesses; --fix NAME VALUE holds a known one")
        texts += _better(result)
    if result["only_sum_of_delays"]:
        texts.append("of the delays before and after the world only the sum is determined: no log separates them")
    if enough:
        texts.append(enough)
    if result["determined"]:
        texts.append(f"next: {record if planned else identify}")
    return texts


def again(pipeline: Pipeline, config: IdentifyConfig, root: Path, flags: str) -> str:
    """Return the command of an identification with the same settings and further flags; "" without flags."""
    return command(pipeline, config, root, flags) if flags else ""


def onward(pipeline: Pipeline, config: IdentifyConfig, root: Path, file: Path) -> str:
    """Return the command that continues an identification that was interrupted or did not converge."""
    usual = pipeline.identify
    effort = {
        "generations": max(config.generations, usual.generations),
        "refine": max(config.refine, usual.refine, 1),
        "refine-steps": max(2 * config.refine_steps, usual.refine_steps),
    }
    flags = " ".join(f"--{name} {number}" for name, number in effort.items())
    return command(pipeline, config, root, f"--begin {shlex.quote(str(file))} {flags}")


def command(pipeline: Pipeline, config: IdentifyConfig, root: Path, flags: str = "") -> str:
    """Return the command of an identification.

    Args:
        pipeline: The robot; settings that equal its defaults need no flag.
        flags: Further flags; they replace those of the settings, bounds and fixed values parameter by parameter.
    """
    further = shlex.split(flags)
    if not pipeline.has_commands:
        call = "sim2real.identify(robot, recording, ...)"
        return f"{call} with the settings {flags}" if flags else call
    named = {name for flag, name in pairwise(further) if flag in ("--bounds", "--fix")}
    words = ["sim2real", "identify", *pipeline.words]
    # Add a flag for each setting that differs from the pipeline's default.
    for f in fields(config):
        flag, value = "--" + f.name.replace("_", "-"), getattr(config, f.name)
        if isinstance(value, Mapping):
            for name, numbers in value.items():
                values = numbers if isinstance(numbers, tuple) else (numbers,)
                words += [] if name in named else [flag, name, *(f"{v:g}" for v in values)]
        elif isinstance(value, tuple):
            words += [word for file in value for word in (flag, str(file))]
        elif value != getattr(pipeline.identify, f.name) and flag not in further:
            words += (
                [flag if value else flag.replace("--", "--no-", 1)] if isinstance(value, bool) else [flag, str(value)]
            )
    words += ["--runs", str(root)] if Path(root) != Path("runs") else []
    return shlex.join([*words, *further])


def _about(recording: Mapping[str, Any], several: bool) -> Iterator[str]:
    """Yield a sentence for each problem of one recording."""
    which = f"{recording['name']}: " if several else ""
    s = recording["sampling"]
    if s["gaps"]:
        yield f"{which}{s['gaps']} gaps in the measurements, the longest {s['longest_gap_s']:.3g} s"
    for j in recording["joints"]:
        if not j["moving"]:
            yield f"{which}{j['name']} does not move at all: nothing about it is determined"
            continue
        if j["moving"] < _MOVING:
            yield f"{which}{j['name']} moves {j['moving']:.0%} of the time: excite it more, or for longer"
        if not _ONE_SIDED < j["forward"] < 1 - _ONE_SIDED:
            yield f"{which}{j['name']} moves almost only one way: friction and an offset then look alike"
        if j["position"]["covered"] < _COVERED:
            share = j["position"]["covered"]
            yield f"{which}{j['name']} stays in {share:.0%} of its range: vary the level of the excitation"
    yield from (f"{which}{sentence}" for sentence in recording["about_torque"])
    if recording["commands"] and all(c["low_hz"] is None for c in recording["commands"]):
        yield f"{which}no command changes: gains and delays of the actuator are not determined"


def _better(result: Mapping[str, Any]) -> list[str]:
    """Return the motions that the undetermined parameters name."""
    open_names = {n for group in result["undetermined"] for n in group}
    motions = [p["excite"] for p in result["parameters"] if p["name"] in open_names and p.get("excite")]
    return [f"record instead: {'; '.join(dict.fromkeys(motions))}"] if motions else []


def _enough(result: Mapping[str, Any]) -> str:
    """Return how long to record, by the parameter with the largest standard error."""
    alone = [p for p in result["parameters"] if p["percent_of_nominal"] is not None and p["determined"] == "alone"]
    if not alone:
        return ""
    worst = max(alone, key=lambda p: p["percent_of_nominal"])
    seconds = 60.0 * (worst["percent_of_nominal"] / (100 * _GOAL)) ** 2
    have = sum(r["sampling"]["duration_s"] for r in result["recordings"])
    about = f"{worst['name']} is least certain: {worst['percent_of_nominal']:.2g} % of nominal from a minute"
    if seconds <= have:
        return f"{about}; {have:.0f} s are enough for {_GOAL:.0%}, if the model is right"
    return f"{about}; {_GOAL:.0%} takes {_time(seconds)} of such data, or a better excitation"


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min" if seconds < 7200 else "hours"
