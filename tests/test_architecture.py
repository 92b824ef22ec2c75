"""The shape of the package: imports flow one way, plotting stays in `plot/`, modules stay small."""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import NamedTuple

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


class Kind(NamedTuple):
    """What a class says of itself."""

    name: str
    bases: tuple[str, ...]
    decorators: tuple[str, ...]
    abstract: bool
    """Whether a method of its own is."""


class Source(NamedTuple):
    """What the tests ask of a module, which is parsed once."""

    imports: frozenset[str]
    loaded: frozenset[str]
    """Those that are made as it is loaded: what is there for types alone excepted."""
    kinds: tuple[Kind, ...]


def imported(nodes: list[ast.AST]) -> frozenset[str]:
    found: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(found)


def kind_of(node: ast.ClassDef) -> Kind:
    bases, decorators = (tuple(map(ast.unparse, each)) for each in (node.bases, node.decorator_list))
    of_methods = [map(ast.unparse, getattr(one, "decorator_list", ())) for one in node.body]
    return Kind(node.name, bases, decorators, any("abstractmethod" in each for each in of_methods))


@cache
def read(source: str) -> Source:
    tree = ast.parse(source)
    for_types = [
        one for one in tree.body if isinstance(one, ast.If) and "TYPE_CHECKING" in ast.dump(one.test)
    ]
    nodes = {one: [*ast.walk(one)] for one in tree.body}
    every, loaded = (
        [node for one, each in nodes.items() if one not in left_out for node in each]
        for left_out in ([], for_types)
    )
    kinds = tuple(kind_of(node) for node in every if isinstance(node, ast.ClassDef))
    return Source(imported(every), imported(loaded), kinds)


def imports(source: str) -> frozenset[str]:
    return read(source).imports


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


def test_modules_import_in_no_circle():
    """Within rooms too."""
    names = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path for path in MODULES}
    left = {name: read(path.read_text()).loaded & names.keys() for name, path in names.items()}
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


def kinds_of(sources: list[str]) -> list[Kind]:
    return [kind for source in sources for kind in read(source).kinds]


def concrete_bases(sources: list[str]) -> set[str]:
    """Classes without an abstract method of their own from which another class derives."""
    kinds = kinds_of(sources)
    bases = {kind.name: {base.partition("[")[0] for base in kind.bases} for kind in kinds}
    abstract = {kind.name for kind in kinds if kind.abstract or bases[kind.name] & {"ABC", "Protocol"}}
    return {base for each in bases.values() for base in each if base in bases} - abstract


def undecorated(sources: list[str]) -> set[str]:
    """Classes from which none derives and that do not say so."""
    kinds = kinds_of(sources)
    bases = {base.partition("[")[0] for kind in kinds for base in kind.bases}
    return {
        kind.name
        for kind in kinds
        if kind.name not in bases and "Protocol" not in kind.bases and "final" not in kind.decorators
    }


UNIT = re.compile(r"\} \{(?!\w*\.?time_unit)[a-z_.]*\.unit\}")
"""A number of an axis or a parameter with its unit, in an f-string."""


def test_units_of_numbers_are_left_out_where_there_is_none():
    """By `units.measured`: a record whose unit is 1 has no "RMSE 0.2 1"."""
    found = [path.name for path in MODULES if UNIT.search(path.read_text())]
    assert found == []
    assert UNIT.search('f"{rms:.3g} {band.unit}"')
    assert not UNIT.search('f"{at:.3g} {self.time_unit}"')


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


def test_what_is_imported_for_types_alone_makes_no_circle():
    source = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import a\ndef f():\n    import b"
    assert read(source).imports == {"typing", "typing.TYPE_CHECKING", "a", "b"}
    assert read(source).loaded == {"typing", "typing.TYPE_CHECKING", "b"}


def test_test_modules_have_names_of_their_own():
    """They import each other's records by name, from whatever directory those are in."""
    names = [path.name for path in Path(__file__).parent.rglob("*.py") if path.name != "__init__.py"]
    assert not {name for name in names if names.count(name) > 1}
