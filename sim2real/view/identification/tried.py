"""The block of an identification's page with the optional terms that were tried."""

from sim2real.artifacts.identification import Identification, tried_table
from sim2real.view.blocks import Block, TableBlock


def tried_blocks(result: Identification) -> list[Block]:
    """Return the table of the tried terms; nothing if none was tried."""
    if not result.tried:
        return []
    caption = "Optional terms: root mean square error on held-out parts, in deviations of a measurement"
    return [TableBlock.of(caption, tried_table(result.tried))]
