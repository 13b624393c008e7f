"""The tables of a deployment on a page: gap, drift, commands played again, times."""

from sim2real.artifacts.deployment import Deployment
from sim2real.view.blocks import Block, TableBlock


def tables(deployed: Deployment) -> list[Block]:
    """Return the gap between robot and simulation, and the tests behind the verdict."""
    blocks: list[Block] = [TableBlock.of("Robot and simulation", deployed.rows())]
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
            f"{deployed.replay[0].horizon_s:g} s ahead, and the expected error of the identification."
        )
        blocks.append(TableBlock.of(caption, deployed.replay_table()))
    if deployed.trained:
        caption = "Times on the robot, and the times that the policy was trained with"
        blocks.append(TableBlock.of(caption, deployed.times_table()))
    return blocks
