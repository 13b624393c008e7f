"""A run on a few lines: one line of progress and the main figures of each stage, then the verdict."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim2real.artifacts.deployment import Deployment
from sim2real.artifacts.run.run_folder import StageFolder, finished
from sim2real.stages.terminal import console
from sim2real.stages.terminal.brief import brief

if TYPE_CHECKING:
    from sim2real.commands.loop.run_loop import CallStage

_FIGURES = {
    "record": ("seconds", "lost replies", "late replies"),
    "identify": ("verdict", "round trip delay", "identified, "),
    "train": ("success in simulation", "what breaks it"),
    "deploy": ("success, deployment", "measured delay"),
}
"""Stage -> the figures of its manifest that are printed, by the beginnings of their names."""
_MAX_FIGURES = 4


def in_brief(call: CallStage) -> CallStage:
    """Return a caller of stages that prints the main figures of each stage instead of its full output."""

    def call_in_brief(stage: str, config: Any, run_dir: Path | None) -> StageFolder:
        with brief():
            done = call(stage, config, run_dir)
        summary = done.manifest["summary"] or {}
        figures = {n: v for prefix in _FIGURES[stage] for n, v in summary.items() if n.startswith(prefix)}
        shown = dict(list(figures.items())[:_MAX_FIGURES])
        if shown:
            print("\n".join(f"  {line}" for line in console.pairs(shown).splitlines()), flush=True)
        return done

    return call_in_brief


def conclude(run_dir: Path | None) -> None:
    """Write the page of a run; print the verdict and the name of the page."""
    if run_dir is None:
        return
    from sim2real.view.page.page import report  # matplotlib and jinja2 take 0.5 s to import

    page = console.shown(report(run_dir))
    deployed = finished(run_dir, "deploy")
    advice = None if deployed is None else Deployment.read(deployed.folder).advice
    result = "the run is finished" if advice is None else f"{advice.status}: {'; '.join(advice.reasons)}"
    print(f"{result}. Open {page}", flush=True)
