"""Output of deploy: timing and warnings of the sessions, the gap to simulation, the tests of the model, the verdict."""

from collections.abc import Mapping, Sequence

from sim2real.artifacts.deployment import Deployment
from sim2real.stages.on_robot.episode import timing_rows
from sim2real.stages.on_robot.open_robot import show_withheld, warn
from sim2real.stages.terminal.console import artifact_table, note, table
from sim2real.types import Json


def show_sessions(summaries: Sequence[Mapping[str, Json]], dry_run: bool, embedded: bool) -> None:
    """Print the timing of the last session and the warnings of all; of a dry run the withheld commands, too."""
    print(table(*timing_rows(summaries[-1])))
    for summary in summaries:
        warn(summary, embedded)
    if dry_run:
        show_withheld(summaries)
        note("dry run: the robot did not move, so there is no gap report")


def show(deployment: Deployment) -> None:
    """Print the gap to simulation, the tests of the model and the verdict of a deployment."""
    if deployment.gap:
        print(artifact_table(deployment.rows()))
    show_verdict(deployment)


def show_verdict(deployment: Deployment) -> None:
    """Print the tests of the model and the verdict of a deployment."""
    if deployment.trained:
        print(artifact_table(deployment.times_table()))
    if deployment.replay:
        print(artifact_table(deployment.replay_table()))
    if deployment.drift is not None:
        print(artifact_table(deployment.drift.rows()))
    if deployment.advice is not None:
        note(f"verdict: {deployment.advice.status}")
        for reason in deployment.advice.reasons:
            note(f"  {reason}")
        if deployment.advice.next:
            note(f"next: {deployment.advice.next}")


def summary_lines(deployment: Deployment, summaries: Sequence[Mapping[str, Json]]) -> dict[str, Json]:
    """Return the lines that the console prints at the end."""
    scores = {f"success, deployment {i}": e.real.get("success") for i, e in enumerate(deployment.episodes)}
    last = summaries[-1]
    return {
        **{name: round(value, 3) for name, value in scores.items() if value is not None},
        **{name: value for name, value in last.items() if name == "measured delay"},
        "lost replies": last["lost_replies"],
        "late replies": last["late_replies"],
        "command timeouts": last["command_timeouts"],
    }
