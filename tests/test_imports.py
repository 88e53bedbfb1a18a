"""Imports run one way: each package only from those above it in ``ORDER``; read from the source, lazy imports too."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import bidex_algos
import bidex_meta
from tests.pages import PAGES, ROOT

PACKAGES = {package.__name__: Path(next(iter(package.__path__))) for package in (bidex_meta, bidex_algos)}

SHARED = ("advantages", "balancing", "labelled", "nets", "replay", "rollout", "trust_region")
"""What learners share."""

ORDER = (
    ("errors", "agents", "bidex_algos"),
    ("utils",),
    ("ladder", "rules"),
    ("engine", "hands", "suite"),
    ("suite_files",),
    ("config", "tasks"),
    ("runs", "world"),
    ("benchmark", "evaluation", "training"),
    ("data", "metaworld", "viewer", "witness", *(f"bidex_algos.{name}" for name in SHARED)),
    ("clients", "worlds", "bidex_algos.learner"),
    ("bidex_algos.offpolicy", "bidex_algos.onpolicy"),
    ("experiments",),
    ("bidex_meta",),  # the package's own names
    ("cli", "bidex_algos.imitation", "bidex_algos.meta", "bidex_algos.multiagent", "bidex_algos.offline"),
)
"""A package imports from earlier lines only, not from its own neighbours; a module at the top counts as one."""

LEVEL = {name: level for level, names in enumerate(ORDER) for name in names}

TWICE = {"base", "config", "learner", "replay", "starts"}
"""Names of several modules. ``base`` is a package's own, ``learner`` contract and base; the others are older."""


def _name(package: str, path: Path) -> str:
    parts = path.relative_to(PACKAGES[package]).with_suffix("").parts
    return ".".join([package, *parts]).removesuffix(".__init__")


@cache
def modules() -> dict[str, ast.Module]:
    """Every module by its full name."""
    return {
        _name(package, path): ast.parse(path.read_text())
        for package, folder in PACKAGES.items()
        for path in sorted(folder.rglob("*.py"))
    }


def imported(tree: ast.Module) -> Iterator[str]:
    """Our modules that a module imports anywhere, functions and annotations included."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, "relative import: write the full name"
            whole = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in modules() else node.module for name in whole]
        else:
            continue
        yield from (name for name in names if name.partition(".")[0] in PACKAGES)


def is_package(module: str) -> bool:
    return any(name.startswith(f"{module}.") for name in modules())


def package_of(module: str) -> str:
    """The package of a module: ``world``, ``bidex_algos.nets``."""
    package, *rest = module.split(".")
    if not rest:
        return package
    return rest[0] if package == "bidex_meta" else f"{package}.{rest[0]}"


def test_imports_come_from_earlier_packages() -> None:
    for module, tree in modules().items():
        own = package_of(module)
        assert own in LEVEL, f"{own} is a new package: give it a line in ORDER and in docs/architecture.md"
        others = {name: package_of(name) for name in imported(tree)}
        wrong = sorted(name for name, other in others.items() if other != own and LEVEL[other] >= LEVEL[own])
        assert not wrong, f"{module} imports {wrong}, of no earlier package"


def test_packages_do_not_know_the_tools() -> None:
    def names(tree: ast.Module) -> Iterator[str]:
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                yield node.module or ""

    assert not [name for name, tree in modules().items() if any(n.split(".")[0] == "tools" for n in names(tree))]


def test_no_module_imports_itself_through_others() -> None:
    graph = {name: set(imported(tree)) - {name} for name, tree in modules().items()}
    while free := {name for name, needed in graph.items() if not needed & graph.keys()}:
        graph = {name: needed for name, needed in graph.items() if name not in free}
    assert not graph, f"a cycle among {sorted(graph)}"


def test_one_table_alone_names_learners() -> None:
    """An import by string would pass the other tests."""
    naming = set()
    for module, tree in modules().items():
        texts = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}  # docstrings
        strings = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in texts]
        if any(isinstance(node.value, str) and "bidex_algos" in node.value for node in strings):
            naming.add(module)
    assert naming == {"bidex_meta.experiments.learners"}


def test_a_name_means_one_module() -> None:
    leaves = [name.rpartition(".")[2] for name, tree in modules().items() if not is_package(name)]
    assert {leaf for leaf in leaves if leaves.count(leaf) > 1} == TWICE


def test_pages_name_modules_that_are_there() -> None:
    named = {
        (page, ROOT / path)
        for page in (*PAGES, ROOT / "CHANGELOG.md")
        for path in re.findall(r"\b(?:bidex_meta|algos/bidex_algos)/[\w/]+\.(?:py|md)\b", page.read_text())
    }
    assert len(named) > 25
    beside = {page: page.parent for page in PAGES if page.parent.parent.name == "bidex_meta"}
    beside[ROOT / "algos" / "README.md"] = PACKAGES["bidex_algos"]
    for page, folder in beside.items():
        paths = re.findall(r"`([\w/]+\.py)`", page.read_text())  # in this folder, or from the root
        named |= {(page, (ROOT if path.startswith(("bidex_meta/", "tests/")) else folder) / path) for path in paths}
    assert not [(page.name, path) for page, path in sorted(named) if not path.is_file()]
