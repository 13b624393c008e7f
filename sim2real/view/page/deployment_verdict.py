"""What a deployment says about its model, on a page: verdict, commands played again, drift, times."""

from __future__ import annotations

from sim2real.artifacts.deployment import Deployment
from sim2real.view.blocks import Block, ListBlock, TableBlock, Tile, number, spoken


def verdict_blocks(deployed: Deployment) -> list[Block]:
    """Return the verdict with its reasons and the command to type; nothing in older files."""
    if deployed.advice is None:
        return []
    items = list(deployed.advice.reasons)
    if deployed.advice.next:
        items.append(f"next: {deployed.advice.next}")
    return [ListBlock(f"Verdict: {deployed.advice.status}", items)]


def verdict_tile(deployed: Deployment) -> list[Tile]:
    """Return the verdict in one word; nothing in older files."""
    return [] if deployed.advice is None else [Tile("verdict", deployed.advice.status, deployed.advice.joint)]


def tables(deployed: Deployment) -> list[Block]:
    """Return what the verdict rests on."""
    blocks: list[Block] = []
    if deployed.drift is not None:
        alarms = set(deployed.drift.alarms)
        rows = [
            [
                *(c.name.replace("_", " "), c.unit or "factor", number(c.before), number(c.now)),
                *(f"{number(c.low95)} to {number(c.high95)}", f"{c.explains:.0%}", "yes" if c.name in alarms else "no"),
            ]
            for c in deployed.drift.changes
        ]
        caption = (
            "Has the robot changed? Each row: what was identified, and what it is now if nothing else has changed, the "
            "one that explains most first. The tests together are set to raise an alarm for "
            f"{deployed.drift.level:.0%} of the robots that have not changed."
        )
        columns = ("changed alone", "unit", "identified", "now", "95 % interval", "explains", "alarm")
        blocks.append(TableBlock(caption, columns, rows, text_columns=(1, 4, 6)))
    if deployed.replay:
        models = list(deployed.replay[0].rmse)
        rows = [[r.name, r.unit, *(number(r.rmse.get(m)) for m in models), number(r.promised)] for r in deployed.replay]
        caption = (
            f"The recorded commands, played again: how far each model's measurements are off the robot's "
            f"{deployed.replay[0].horizon_s:g} s ahead, and what the identification promised."
        )
        blocks.append(TableBlock(caption, ("position", "unit", *models, "promised"), rows, text_columns=(1,)))
    if deployed.trained:
        rows = [[*spoken(g.quantity), number(g.real), number(g.simulation), number(g.gap)] for g in deployed.trained]
        caption = "Times on the robot, and those that the policy was trained with"
        blocks.append(TableBlock(caption, ("time", "unit", "robot", "in training", "gap"), rows, text_columns=(1,)))
    return blocks
