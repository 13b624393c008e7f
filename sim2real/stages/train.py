"""Train a policy on the identified model, with the timing that the robot really has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sim2real.artifacts.bundle import Bundle, History
from sim2real.artifacts.episodes import Episodes
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.manifest import sha256
from sim2real.artifacts.run_folder import StageFolder, newest, open_stage
from sim2real.artifacts.timing import Timing
from sim2real.policy.contract import PolicyContract
from sim2real.robots.base import Robot
from sim2real.stages.config import TrainConfig
from sim2real.stages.console import note, progress, table
from sim2real.stages.interruption import patiently
from sim2real.stages.parameters import open_identification
from sim2real.stages.pipeline import Pipeline, pipeline_of
from sim2real.stages.prepared import prepare, require_accepted, timing_of
from sim2real.stages.robot import moving_robot
from sim2real.train.ppo import Progress, TrainResult
from sim2real.train.ppo import train as learn


def train(
    robot: Robot | Pipeline,
    config: TrainConfig | None = None,
    identification: Identification | None = None,
    timing: Timing | None = None,
) -> tuple[Bundle, dict[str, Any]]:
    """Train a policy.

    Args:
        robot: The robot, or its pipeline.
        config: How; default: that of the pipeline that loaded the robot. The file that it may name is not read.
        identification: What identify found; the nominal model needs none.
        timing: How long everything takes on the robot; default: as in the recording that was identified from. The
            nominal model has no delays.

    Returns:
        The policy with what it expects and promises, and numbers about the training.

    Raises:
        UsageError: When the identified model is asked for without an identification, or in another world.
        Sim2RealError: When the identification is of another robot or was not accepted, or its timing cannot be trained
            with.
    """
    pipeline = pipeline_of(robot)
    config = config or pipeline.train
    made = prepare(pipeline, config, identification, timing)
    ppo = replace(config.ppo, eval_steps=made.env.length + 1)
    with progress(ppo.evaluations, "train (compiling)") as bar:
        result = patiently(lambda: learn(made.env, ppo, jax.random.key(config.seed), lambda p: _report(bar, p)))
    contract = _contract(made.robot, made.env.task, made.values)
    bundle = Bundle(contract, result.best.to_weights(), _history(result), made.episodes)
    about = {
        "model": config.model,
        "success in simulation": f"{result.history['success'].max():.2f} (seed {result.best_seed})",
        "policy steps": int(result.env_steps[-1]) * ppo.num_seeds,
        "policy steps a second": round(result.env_steps_per_s),
        "compile": f"{result.compile_s:.1f} s",
        "train": f"{result.train_s:.1f} s",
        "episodes that end at a pause": f"{made.episodes.cut} of {made.episodes.timelines}",
        "timelines drawn again": made.episodes.again,
    }
    return bundle, about


def run(pipeline: Pipeline, config: TrainConfig, root: Path, run_dir: Path | None) -> StageFolder:
    """Train, and write the policy bundle into a stage folder.

    Args:
        pipeline: The robot.
        config: The stage's configuration.
        root: Folder of all runs.
        run_dir: Run folder to add to; None takes the one of the parameters, or a new one for the nominal model.
    """
    moving_robot(pipeline)  # before anything is read
    path, run_dir = _find_parameters(pipeline, config, root, run_dir)
    identification = None if path is None else open_identification(path, pipeline)
    if identification is not None:  # what is refused is refused before a folder is made
        timing_of(identification)
        require_accepted(identification, config)
        if identification.verdict.status != "accepted":
            note(f"trains on an identification that is not accepted: {identification.verdict.status}")
    inputs = {} if path is None else {"parameters": path}
    if config.explain:
        return _explain(pipeline, config, identification, inputs, root, run_dir)
    with open_stage(root, pipeline.name, "train", config, inputs, run_dir) as stage:
        bundle, about = train(pipeline, config, identification)
        hashes = {name: sha256(file) for name, file in inputs.items()}
        if identification is not None and identification.logs:
            hashes["log"] = identification.logs[0].sha256
        bundle = replace(bundle, contract=replace(bundle.contract, hashes=hashes))
        for name, file in bundle.save(stage.folder).items():
            stage.output(name, file)
        if bundle.history is not None:
            print(table(*_rows(bundle.history)))
        stage.summary(about)
    return stage.result


def _explain(
    pipeline: Pipeline,
    config: TrainConfig,
    identification: Identification | None,
    inputs: Mapping[str, Path],
    root: Path,
    run_dir: Path | None,
) -> StageFolder:
    """Show what episodes are drawn from, in a folder of its own, and train nothing."""
    with open_stage(root, pipeline.name, "explain", config, inputs, run_dir) as stage:
        episodes = prepare(pipeline, config, identification).episodes
        for name, file in episodes.save(stage.folder).items():
            stage.output(name, file)
        from sim2real.view.episodes import picture  # matplotlib takes 0.5 s to import

        picture(stage.output("picture", "episodes.png"), episodes)
        print(table(*parameter_rows(episodes)))
        if episodes.noise:
            print(table(*noise_rows(episodes)))
        stage.summary(
            {
                "posterior": f"deviations times {episodes.widening:.1f}, for what the model leaves unexplained",
                "timelines": episodes.timelines,
                "episodes that end at a pause": episodes.cut,
                "timelines drawn again": episodes.again,
                "longest pause": f"{1e3 * episodes.longest_pause_s:.1f} ms",
            }
        )
    return stage.result


def parameter_rows(episodes: Episodes) -> tuple[list[list[Any]], list[str]]:
    """Return the table of what is drawn of each parameter: rows and headers."""
    rows = []
    for p in episodes.parameters:
        drawn = episodes.draws[p.name]
        low, high = np.quantile(drawn, [0.025, 0.975])
        known = "" if p.low95 is None or p.high95 is None else f"[{p.low95:.4g}, {p.high95:.4g}]"
        rows.append([p.name, p.value, known, f"[{low:.4g}, {high:.4g}]", p.unit, "left open by the log" * p.open])
    return rows, ["parameter", "value", "95 % identified", "95 % drawn", "unit", ""]


def noise_rows(episodes: Episodes) -> tuple[list[list[Any]], list[str]]:
    """Return the table of what readings have on top of the motion: rows and headers."""
    rows = [[n.column, n.deviation, n.quantum, n.bias, n.unit] for n in episodes.noise]
    return rows, ["reading", "deviation", "step", "bias", "unit"]


def _find_parameters(
    pipeline: Pipeline, config: TrainConfig, root: Path, run_dir: Path | None
) -> tuple[Path | None, Path | None]:
    """Return the identification to train on, None for the nominal model, and the run folder to write into."""
    if config.model == "nominal":
        return None, run_dir
    if config.parameters is not None:
        return Path(config.parameters), run_dir
    found = newest(root, pipeline.name, "identify", run_dir)
    return found.output("parameters"), run_dir or found.run_dir


def _contract(robot: Robot, task: Any, values: Mapping[str, float]) -> PolicyContract:
    return PolicyContract(
        observation=robot.observation,
        action=tuple(
            replace(term, low=float(low), high=float(high))
            for term, low, high in zip(robot.action, task.action_low, task.action_high, strict=True)
        ),
        rate_hz=robot.rate_hz,
        delays_s={n: v for n, v in values.items() if n.endswith("_delay")},
        hashes={},
    )


def _report(bar: Any, p: Progress) -> None:
    bar.set_description_str("train")
    bar.update(1)
    bar.set_postfix_str(f"return {p.values['return'].max():.0f}, success {p.values['success'].max():.2f}")


def _history(result: TrainResult) -> History:
    curves = {name: np.asarray(v, np.float64) for name, v in result.history.items()}
    return History(
        steps=np.asarray(result.env_steps, np.float64),
        seconds=np.asarray(result.elapsed_s, np.float64),
        returns=curves.pop("return"),
        success=curves.pop("success"),
        best_seed=result.best_seed,
        compile_s=result.compile_s,
        train_s=result.train_s,
        env_steps_per_s=result.env_steps_per_s,
        others=curves,
    )


def _rows(history: History) -> tuple[list[list[Any]], list[str]]:
    rows = [
        [int(steps), round(float(seconds), 1), float(ret.max()), float(success.max())]
        for steps, seconds, ret, success in zip(
            history.steps, history.seconds, history.returns, history.success, strict=True
        )
    ]
    return rows, ["steps", "seconds", "return", "success"]
