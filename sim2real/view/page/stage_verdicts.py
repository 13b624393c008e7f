"""The verdicts on record, train and deploy, as boxes of a page."""

from sim2real.artifacts.bundle import GOOD_SUCCESS
from sim2real.artifacts.deployment import Deployment
from sim2real.view.blocks import Banner, Tone, number, sentence
from sim2real.view.page.servos import DRY, MAX_LATE
from sim2real.view.signals import Signals

_DEPLOYED: dict[str, Tone] = {"fine": "good", "look at this joint": "bad"}


def record_banner(log: Signals) -> Banner:
    """Return the verdict on a recording: whether it is complete, and its answers came in time."""
    if log.dry:
        return DRY
    end = log.episode.metadata.get("log", {}).get("session_end") or {}
    faults = list(log.warnings)
    late = int(end.get("late_replies") or 0) / max(1, int(end.get("transactions") or 0))
    if late > MAX_LATE:
        faults.append(f"{late:.1%} of the answers came so late that the time of the sample is uncertain.")
    if faults:
        return Banner("doubt", "Incomplete" if log.warnings else "Late answers", faults)
    lost = f"; {number(end['lost_replies'])} lost answers were requested again" if "lost_replies" in end else ""
    return Banner("good", "Complete", [f"{log.episode.duration_s:.1f} s{lost}."])


def train_banner(success: float) -> Banner:
    """Return the verdict on a training.

    Args:
        success: Share of success in simulation of the policy in the bundle.
    """
    good = success >= GOOD_SUCCESS
    reason = f"The limit is {GOOD_SUCCESS:.0%}, the same as for success on the robot."
    return Banner("good" if good else "doubt", f"{success:.0%} success in simulation", [reason])


def deploy_banner(deployed: Deployment) -> Banner | None:
    """Return the verdict on a deployment: the first reason, the next command, further reasons; None for older files."""
    advice = deployed.advice
    if advice is None:
        return None
    title = f"{advice.status[:1].upper()}{advice.status[1:]}" + (f": {advice.joint}" if advice.joint else "")
    names = [row.name for row in deployed.replay]
    reasons = [sentence(reason, names) for reason in advice.reasons]
    reasons[1:1] = [f"next: {advice.next}"] if advice.next else []
    return Banner(_DEPLOYED.get(advice.status, "doubt"), title, reasons)
