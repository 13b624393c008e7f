"""What a stage that moves a robot says about its rig: when it opens, and afterwards."""

from __future__ import annotations

from sim2real.stages.console import note
from sim2real.stages.robot import Session


def announce(session: Session) -> None:
    """Say what the servos do by themselves when this computer's side dies, and what stops them then."""
    for line in session.rig.bus.without_host():
        note(f"if this process dies, {line}; the guardian takes the torque off")
