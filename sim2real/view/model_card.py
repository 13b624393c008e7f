"""The page of a model card: its numbers, the limits of its data, and the recipe of each figure."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sim2real.artifacts.identification import Link
from sim2real.artifacts.summary import ArtifactTable, Interval
from sim2real.types import Json
from sim2real.view.blocks import Banner, Block, ListBlock, NoteBlock, PageSection, TableBlock, sentence
from sim2real.view.identification import link_blocks
from sim2real.view.page import write_page

PAGE = "card.html"


def model_card_page(
    card: Mapping[str, Json], signals: Mapping[str, np.ndarray], folder: Path, links: Sequence[Link] = ()
) -> Path:
    """Write the page of a card into its folder.

    Args:
        card: The document of ``card.json``.
        signals: Arrays of ``signals.npz``.
        links: Links whose delays' distribution was estimated.
    """
    about, status = card["about"], card["verdict"]["status"]
    blocks: list[Block] = [NoteBlock(text) for text in card["notes"]]
    headers = ("parameter", "estimate", "95 % interval", "unit", "state", "about")
    rows = [
        [p["name"], p["estimate"], Interval(p["low95"], p["high95"]), p["unit"], p["state"], p["about"]]
        for p in card["parameters"]
    ]
    blocks.append(TableBlock.of("Parameters", ArtifactTable(headers, rows)))
    blocks += link_blocks(links)
    times = {n.removeprefix("times/"): v for n, v in signals.items() if n.startswith("times/")}
    if times:
        quantiles: list[list[Json]] = [
            [n, *(1e3 * np.quantile(v, [0.5, 0.95, 0.99, 1.0])).tolist()] for n, v in times.items()
        ]
        table = ArtifactTable(("times [ms]", "p50", "p95", "p99", "max"), quantiles)
        blocks.append(TableBlock.of("Recorded times in the log", table))
    blocks.append(ListBlock("Not known", card["unknown"] or ["every parameter of the model was identified"]))
    blocks.append(ListBlock("Firmware, supply and temperature", [f"{n}: {v}" for n, v in card["session"].items()]))
    if card["simulation"]:
        caption = f"Numbers of the drives: the function {card['simulation']['law']} in reproduce.py"
        blocks.append(TableBlock.of(caption, _numbers(card["simulation"])))
    blocks.append(ListBlock("Logs", [f"{log['name']}, SHA-256 {log['sha256']}" for log in card["logs"]]))
    figures: list[list[Json]] = [[f["name"], f["value"], f["unit"], _recipe(f["recipe"])] for f in card["figures"]]
    caption = "Figures: the motion and times that the log covers, and errors to expect"
    blocks.append(TableBlock.of(caption, ArtifactTable(("figure", "value", "unit", "recipe"), figures)))
    reasons = [sentence(reason) for reason in card["verdict"]["reasons"]]
    tone = "good" if status == "accepted" else "doubt"
    lead = (
        "python reproduce.py computes each figure again with numpy and MuJoCo alone, from the files beside this page."
    )
    section = PageSection("card", "Model card", lead, (), blocks, Banner(tone, status.capitalize(), reasons))
    return write_page(folder / PAGE, about["pipeline"], [section], version=about["sim2real"])


def _recipe(recipe: Mapping[str, Json]) -> str:
    """Return a recipe of ``card.json`` as text."""
    if "signal" in recipe:
        return f"quantile {recipe['q']:g} of {recipe['signal']}"
    field, run, horizon_s = (recipe[name] for name in ("field", "run", "horizon_s"))
    return f"simulation less measurement of {field}, segments {run}, settle_s to {horizon_s:g} s later"


def _numbers(simulation: Mapping[str, Json]) -> ArtifactTable:
    """Return the numbers of the timing and of the drive, a row each; a list is one text."""
    scalars = ("tick_s", "command_delay_s", "measurement_delay_s", "lead_s", "velocity_lead_s", "settle_s")
    rows: list[Sequence[Json]] = [[name, _text(simulation[name])] for name in scalars]
    rows += [[name, _text(value)] for name, value in simulation["numbers"].items()]
    return ArtifactTable(("number", "value"), rows)


def _text(value: Json) -> str:
    if isinstance(value, list):
        same = len(value) > 1 and all(v == value[0] for v in value)
        return f"{value[0]:.6g} of each" if same else ", ".join(f"{v:.6g}" for v in value)
    return f"{value:.6g}"
