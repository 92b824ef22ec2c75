"""The shape of the package: imports flow one way, plotting stays in `plot/`, modules stay small."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "lcopa_bayes"
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path.name != "__init__.py")

ORDER = (
    ("core",),
    ("data",),
    ("model",),
    ("bench", "optics"),
    ("inference",),
    ("sampling",),
    ("results",),
    ("identifiability", "effectsearch", "calibration", "fleets"),
    ("experiments", "comparison"),
    ("paper",),
    ("plot",),
    ("report",),
    ("verbs",),
    ("cli",),
)
"""Rooms from the foundation to the command line; a module imports only from rows above its own, or from its
own room."""
LOOSE = {"cli"}
"""Modules that stand in no room."""
PLOTTING = {"matplotlib", "corner"}
OPEN = {"InputError", "Ruled", "RidgeMove", "ScatterEffect", "StoredResult"}
"""Classes that others derive from though no method of their own is abstract."""
LONGEST = 400


def row_of(part: str) -> int:
    for number, row in enumerate(ORDER):
        if part in row:
            return number
    raise AssertionError(f"{part} has no place in ORDER; give it one")


def place(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(source: str) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return found


def breaches(part: str, source: str) -> list[str]:
    """Imports of the package from the module's own row or below it, its own room excepted."""
    used = {name.split(".")[1] for name in imports(source) if name.startswith("lcopa_bayes.")}
    return sorted(other for other in used if other != part and row_of(other) >= row_of(part))


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_flow_down(path: Path):
    assert breaches(place(path), path.read_text()) == []


def test_a_breach_is_seen():
    assert breaches("data", "from lcopa_bayes.results.fit import Fit") == ["results"]
    assert breaches("data", "from lcopa_bayes.core.arrays import frozen") == []


def test_every_module_stands_in_a_room():
    assert {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"} == LOOSE
    rooms = {path.parent.name for path in PACKAGE.glob("*/*.py")}
    assert rooms == {part for row in ORDER for part in row} - LOOSE


def loaded(source: str) -> set[str]:
    """Imports that are made as a module is loaded: those for types alone excepted."""
    tree = ast.parse(source)
    typing = [
        node for node in tree.body if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
    ]
    tree.body = [node for node in tree.body if node not in typing]
    return imports(ast.unparse(tree))


def test_modules_import_in_no_circle():
    """Within rooms too."""
    names = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path for path in MODULES}
    left = {name: loaded(path.read_text()) & names.keys() for name, path in names.items()}
    while free := {name for name, used in left.items() if not used & left.keys()}:
        left = {name: used for name, used in left.items() if name not in free}
    assert sorted(left) == []


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_only_figures_plot(path: Path):
    """All drawing is in `plot/`; a page only makes SVG of what that returns."""
    used = {name.split(".")[0] for name in imports(path.read_text())}
    assert place(path) == "plot" or path == PACKAGE / "report" / "svg.py" or not used & PLOTTING


@pytest.mark.parametrize("name", ["path", "literature"])
def test_what_model_and_bench_share_calculates_no_response(name: str):
    source = (PACKAGE / "model" / f"{name}.py").read_text()
    used = {".".join(each.split(".")[:3]) for each in imports(source) if each.startswith("lcopa_bayes.")}
    assert used <= {"lcopa_bayes.core.errors", "lcopa_bayes.model.path"}
    assert not {each.split(".")[0] for each in imports(source)} & {"numpy", "scipy"}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_modules_are_one_sitting_long(path: Path):
    assert len(path.read_text().splitlines()) <= LONGEST


def concrete_bases(sources: list[str]) -> set[str]:
    """Classes without an abstract method of their own from which another class derives."""
    classes = [
        node for source in sources for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ClassDef)
    ]
    bases = {node.name: {ast.unparse(base).partition("[")[0] for base in node.bases} for node in classes}
    abstract = {
        node.name
        for node in classes
        if bases[node.name] & {"ABC", "Protocol"}
        or any("abstractmethod" in map(ast.unparse, getattr(one, "decorator_list", ())) for one in node.body)
    }
    return {base for each in bases.values() for base in each if base in bases} - abstract


def undecorated(sources: list[str]) -> set[str]:
    """Classes from which none derives and that do not say so."""
    classes = [
        node for source in sources for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ClassDef)
    ]
    bases = {ast.unparse(base).partition("[")[0] for node in classes for base in node.bases}
    return {
        node.name
        for node in classes
        if node.name not in bases
        and "Protocol" not in map(ast.unparse, node.bases)
        and "final" not in map(ast.unparse, node.decorator_list)
    }


def test_every_class_is_abstract_or_final():
    """Nothing concrete is overridden: what a class does is read in one place."""
    sources = [path.read_text() for path in MODULES]
    assert concrete_bases(sources) == OPEN
    assert undecorated(sources) == set()


def test_a_concrete_base_is_seen():
    assert concrete_bases(["class A: ...", "class B(A): ..."]) == {"A"}
    assert concrete_bases(["class A(ABC): ...", "class B(A): ..."]) == set()
    assert undecorated(["class A(ABC): ...", "class B(A): ..."]) == {"B"}


def test_importing_has_no_side_effects():
    code = (
        "import sys, lcopa_bayes; "
        "sys.exit(bool({'matplotlib', 'corner', 'emcee', 'pandas'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


def test_test_modules_have_names_of_their_own():
    """They import each other's records by name, from whatever directory those are in."""
    names = [path.name for path in Path(__file__).parent.rglob("*.py") if path.name != "__init__.py"]
    assert not {name for name in names if names.count(name) > 1}
