"""Output of validate: the errors on the later logs and the verdict."""

from collections.abc import Mapping

from sim2real.artifacts.identification import MAX_ERROR_RATIO, promises_table
from sim2real.stages.estimation.promises import broken_sentences
from sim2real.stages.terminal.console import MOST_PROMISES, artifact_table, note, table
from sim2real.stages.validate.result import ACCEPTED
from sim2real.types import Json


def show(result: Mapping[str, Json]) -> None:
    """Print the errors as a table, then the verdict."""
    logs = len({row.source for row in result["ledger"]})
    which = "this log" if logs < 2 else f"these {logs} logs"
    models = list(dict.fromkeys(m for row in result["positions"].values() for m in row["rmse"]))
    cells = [[n, *(row["rmse"].get(m) for m in models), row["unit"]] for n, row in result["positions"].items()]
    print(table(cells, [f"off {result['horizon_s']:g} s ahead", *models, "unit"]))
    if (promises := promises_table(result["ledger"])).rows:
        print(artifact_table(promises, MOST_PROMISES))
    print(
        f"all positions: {result['rmse']:.4g} {result['horizon_s']:g} s ahead, "
        f"{result['free_run_rmse']:.4g} in free runs"
    )
    drawn = result["drawn"]
    for row in drawn[:MOST_PROMISES]:
        ends = f"{row['low95']:.2g} to {row['high95']:.2g}"
        print(f"{row['column']} in a free run of {row['log']}: off by {ends} for 95 % of draws of the posterior")
    if more := drawn[MOST_PROMISES:]:
        note(f"and {len(more)} more intervals of draws: --json has all")
    if resting := [name for name, row in result["positions"].items() if not row["moves"]]:
        note(f"{', '.join(resting)} did not move here, which neither keeps a promise nor breaks one")
    for sentence in result["beyond"]:
        note(f"beyond the fitted data, so bounds are wider: {sentence}")
    for sentence in broken_sentences(result["ledger"]) if result["better"] else ():
        note(sentence)
    if not result["better"]:
        beaten = {n: row["beaten_by"] for n, row in result["positions"].items() if row["beaten_by"]}
        listed = "; ".join(f"{n} by {', '.join(by)}" for n, by in list(beaten.items())[:3])
        note(f"verdict: no improvement on {which}: beaten are {listed}")
    elif result["promise_kept"] is False:
        note(f"verdict: better than the baselines, but more than {MAX_ERROR_RATIO:g} times as far off as was promised")
    elif result["fitted"]:
        note("verdict: none: a log that was fitted is no test")
    elif result["promise_kept"] is None:
        note(f"verdict: better than the baselines on {which}; no bound was promised")
    else:
        note(f"verdict: holds on {which}")
    if result["identified"] != ACCEPTED:
        note(f"the identification itself was not accepted: {result['identified']}: {'; '.join(result['why'][:1])}")
