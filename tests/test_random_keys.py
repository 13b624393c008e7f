"""Random keys: each is split, or folded, or used up, and never two of these: the streams would be the same numbers."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILES = sorted(f for room in ("sim2real", "pipelines", "scripts") for f in (ROOT / room).rglob("*.py"))


def uses(function: ast.AST) -> dict[str, set[str]]:
    """Return how each key of a function is used: expression -> {"fold_in", "split", "other calls"}."""
    found: dict[str, set[str]] = {}
    for call in ast.walk(function):
        if not isinstance(call, ast.Call) or not call.args:
            continue
        text = ast.unparse(call.func)
        kind = text.rsplit(".", 1)[-1] if text.startswith("jax.random.") else "another call"
        for argument in call.args:
            if isinstance(argument, ast.Name | ast.Attribute):
                found.setdefault(ast.unparse(argument), set()).add(kind)
    return found


def functions(file: Path) -> list[ast.FunctionDef]:
    text = file.read_text()
    return [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.FunctionDef)] if "fold_in" in text else []


def test_a_key_that_is_folded_has_no_other_use():
    mixed = [
        (str(file.relative_to(ROOT)), function.name, name)
        for file in FILES
        for function in functions(file)
        for name, kinds in uses(function).items()
        if "fold_in" in kinds and kinds != {"fold_in"}
    ]
    assert not mixed
