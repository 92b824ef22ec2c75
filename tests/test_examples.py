"""Every notebook of `examples/` runs, shows its figures, and is named on the page of the documentation."""

import ast
import json
from pathlib import Path

import pytest
from matplotlib.figure import Figure

EXAMPLES = Path(__file__).parents[1] / "examples"
NOTEBOOKS = sorted(EXAMPLES.glob("*.ipynb"))
LONG = ("identifiability-audit", "model-comparison", "next-experiment", "posterior-report")
"""Those that the short form leaves out."""


def run(cells: list[str]) -> list[object]:
    """Values that the cells end with, as a notebook shows them."""
    names: dict[str, object] = {}
    shown = []
    for cell in cells:
        tree = ast.parse(cell)
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, "cell", "exec"), names)
        if last is not None:
            shown.append(eval(compile(ast.Expression(last.value), "cell", "eval"), names))
    return shown


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, id=path.stem, marks=[pytest.mark.slow] * (path.stem in LONG)) for path in NOTEBOOKS],
)
def test_a_notebook_runs(path, monkeypatch):
    monkeypatch.chdir(EXAMPLES)
    cells = json.loads(path.read_text("utf-8"))["cells"]
    assert cells[0]["source"][0].startswith("# ")
    shown = run(["".join(one["source"]) for one in cells if one["cell_type"] == "code"])
    assert any(isinstance(one, Figure) for one in shown)
    for one in shown:
        assert not isinstance(one, Figure) or one._repr_png_()
        assert one is not None


def test_a_cell_that_fails_is_seen():
    with pytest.raises(ZeroDivisionError):
        run(["a = 1", "a / 0"])


def test_notebooks_are_small_and_reached_from_the_documentation():
    text = (EXAMPLES.parent / "docs" / "python.md").read_text("utf-8")
    assert len(NOTEBOOKS) == 5
    for path in NOTEBOOKS:
        assert path.stat().st_size < 200_000
        assert f"../examples/{path.name}" in text
