"""The tables and texts that the stage train prints."""

from collections.abc import Callable
from typing import Any

from sim2real.artifacts.bundle import History
from sim2real.artifacts.episodes import Episodes
from sim2real.stages.terminal.console import artifact_table, table
from sim2real.training.config import PPOConfig
from sim2real.training.ppo.result import Progress, TrainResult
from sim2real.training.sweep import Sweep
from sim2real.types import Json

Cell = str | int | float | None
Table = tuple[list[list[Cell]], list[str]]
"""Rows and headers."""


Watch = Callable[[Progress], None]
"""A function that receives the figures of each evaluation."""


def show_progress(bar: Any, p: Progress, watch: Watch | None) -> None:
    """Show an evaluation's figures behind the progress bar, after ``watch`` has received them."""
    if watch is not None:
        watch(p)
    bar.set_description_str("train")
    bar.update(1)
    width = f", {p.values['width'].max():.2f} of the differences" if "width" in p.values else ""
    bar.set_postfix_str(f"return {p.values['return'].max():.0f}, success {p.values['success'].max():.2f}{width}")


def show_history(history: History) -> None:
    """Print the curves of a training, the terms of its reward, and the settings of a sweep."""
    print(table(*curve_rows(history)))
    if history.terms:
        print(table(*term_rows(history)))
    if history.settings:
        print(table(*sweep_rows(history)))


def show_episodes(episodes: Episodes) -> None:
    """Print the draws of parameters and the noise of readings."""
    print(artifact_table(episodes.rows()))
    if episodes.noise:
        print(artifact_table(episodes.noise_table()))


def training_summary(result: TrainResult, ppo: PPOConfig, sweep: Sweep, episodes: Episodes) -> dict[str, Json]:
    """Return the figures of a training for its summary and its bundle."""
    best = sweep.names(ppo.num_seeds)[result.best_seed]
    return {
        "success in simulation": f"{result.history['success'].max():.2f} ({best})",
        "policy steps": int(result.env_steps[-1]) * len(result.members),
        **({} if ppo.target is None else {"target": _target_text(result, ppo.target)}),
        "policy steps a second": round(result.env_steps_per_s),
        "compile": f"{result.compile_s:.1f} s",
        "train": f"{result.train_s:.1f} s",
        "episodes that end at a pause": f"{episodes.cut} of {episodes.timelines}",
        "timelines drawn again": episodes.again,
        **disturbance_rows(episodes),
        **_reached(result, episodes),
    }


def _reached(result: TrainResult, episodes: Episodes) -> dict[str, Json]:
    """Return the share of a curriculum that follows success at the end; empty without one."""
    if not episodes.follow:
        return {}
    share, last = float(result.history["width"][-1][result.best_seed]), episodes.curriculum[1]
    late = "" if share >= last - 1e-6 else f" of {last:g}: success did not stay above {episodes.follow:g}"
    return {"share reached": f"{share:.2f}{late}"}


def episode_summary(episodes: Episodes) -> dict[str, Json]:
    """Return the figures of ``--explain``."""
    return {
        "posterior": f"deviations times {episodes.widening:.1f}, for the misfit of the model",
        "timelines": episodes.timelines,
        "episodes that end at a pause": episodes.cut,
        "timelines drawn again": episodes.again,
        "longest pause": f"{1e3 * episodes.longest_pause_s:.1f} ms",
        **disturbance_rows(episodes),
    }


def curve_rows(history: History) -> Table:
    """Return the table of the best return and success at each evaluation."""
    curves = (history.steps, history.seconds, history.returns, history.success)
    rows: list[list[Cell]] = [
        [int(steps), round(float(seconds), 1), float(returns.max()), float(success.max())]
        for steps, seconds, returns, success in zip(*curves, strict=True)
    ]
    return rows, ["steps", "seconds", "return", "success"]


def term_rows(history: History) -> Table:
    """Return the table of each reward term's part of the return, for the best policy's seed at each evaluation."""
    seed = history.best_seed or 0
    columns = [history.steps.astype(int), history.returns[:, seed], *(c[:, seed] for c in history.terms.values())]
    rows = [list(row) for row in zip(*(column.tolist() for column in columns), strict=True)]
    return rows, ["steps", "return", *(f"of it {name}" for name in history.terms)]


def sweep_rows(history: History) -> Table:
    """Return a row for each of the settings of a sweep: success over its seeds, and return."""
    rows: list[list[Cell]] = []
    for setting in dict.fromkeys(history.settings):
        seeds = [i for i, name in enumerate(history.settings) if name == setting]
        success, returns = history.success[:, seeds], history.returns[:, seeds]
        mark = "*" if history.best_seed in seeds else ""
        last = success[-1]
        rows.append([setting, *map(float, (last.mean(), last.min(), success.max(), returns[-1].mean())), mark])
    return rows, ["settings", "success", "worst seed", "best so far", "return", "kept"]


def disturbance_rows(episodes: Episodes) -> dict[str, Json]:
    """Return texts on pushes and the curriculum; empty without them."""
    rows: dict[str, Json] = {"pushes": f"{episodes.push_hz:g} a second for each joint"} if episodes.push_hz else {}
    if episodes.curriculum != (1.0, 1.0):
        first, last = episodes.curriculum
        text = f"{first:g} of these differences at the first update, "
        how = f"up to {last:g} while success is above {episodes.follow:g}"
        rows["curriculum"] = text + (how if episodes.follow else f"{last:g} at the last one")
    return rows


def _target_text(result: TrainResult, target: float) -> str:
    best = result.history["success"][-1].max()
    if best < target:
        return f"{target:g} not reached: {best:.2f} at the end"
    return f"{target:g} reached after {int(result.env_steps[-1]):,} policy steps of each seed"
