"""The verdict on a deployment, on a page: reasons, commands played again, drift, times."""

from __future__ import annotations

from sim2real.artifacts.deployment import Deployment
from sim2real.view.blocks import Block, ListBlock, TableBlock, Tile


def verdict_blocks(deployed: Deployment) -> list[Block]:
    """Return the verdict with its reasons and the next command; empty for older files."""
    if deployed.advice is None:
        return []
    items = list(deployed.advice.reasons)
    if deployed.advice.next:
        items.append(f"next: {deployed.advice.next}")
    return [ListBlock(f"Verdict: {deployed.advice.status}", items)]


def verdict_tile(deployed: Deployment) -> list[Tile]:
    """Return the verdict as a tile; empty for older files."""
    return [] if deployed.advice is None else [Tile("verdict", deployed.advice.status, deployed.advice.joint)]


def tables(deployed: Deployment) -> list[Block]:
    """Return the tables of the tests behind the verdict."""
    blocks: list[Block] = []
    if deployed.drift is not None:
        caption = (
            "Has the robot changed? Each row compares one estimate with its value in the new log, if only this has "
            "changed. The first row explains the largest share of the error. For a robot that has not changed, the "
            f"tests together raise a false alarm in {deployed.drift.level:.0%} of the logs."
        )
        blocks.append(TableBlock.of(caption, deployed.drift.rows()))
    if deployed.replay:
        caption = (
            "The recorded commands, played again on models: root mean square error of each model's prediction "
            f"{deployed.replay[0].horizon_s:g} s ahead, and the error that the identification promised."
        )
        blocks.append(TableBlock.of(caption, deployed.replay_table()))
    if deployed.trained:
        caption = "Times on the robot, and the times that the policy was trained with"
        blocks.append(TableBlock.of(caption, deployed.times_table()))
    return blocks
