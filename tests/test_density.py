"""Check that a line of the source holds one assignment, one loop and one condition at most."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FILES = [file for folder in ("bidex_meta", "algos", "suites") for file in sorted((ROOT / folder).rglob("*.py"))]
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
BLOCKS = (ast.stmt, ast.excepthandler, ast.match_case)


def offenders(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and rule of everything that is too dense."""
    constants = {id(statement) for scope in ast.walk(tree) for statement in constants_of(scope)}
    for node in ast.walk(tree):
        if isinstance(node, COMPREHENSIONS):
            if len(node.generators) > 1:
                yield node.lineno, "a comprehension has one for"
            if node.end_lineno != node.lineno:
                yield node.lineno, "a comprehension fits on one line"
        if isinstance(node, ast.Assign) and id(node) not in constants and assigns_several(node):
            yield node.lineno, "one assignment a line"
        if isinstance(node, ast.stmt) and sum(isinstance(part, ast.IfExp) for part in own_parts(node)) > 1:
            yield node.lineno, "at most one conditional expression in a statement"


def constants_of(scope: ast.AST) -> list[ast.stmt]:
    """Return the statements of a module or class, where several constants may share a docstring."""
    return scope.body if isinstance(scope, ast.Module | ast.ClassDef) else []


def assigns_several(node: ast.Assign) -> bool:
    """Return whether a tuple of values is assigned to a tuple of names."""
    return isinstance(node.value, ast.Tuple) and any(isinstance(target, ast.Tuple) for target in node.targets)


def own_parts(statement: ast.stmt) -> Iterator[ast.AST]:
    """Yield the expressions of a statement, without those of the statements within it."""
    waiting: list[ast.AST] = [statement]
    while waiting:
        node = waiting.pop()
        yield node
        waiting += [child for child in ast.iter_child_nodes(node) if not isinstance(child, BLOCKS)]


def test_the_source_is_not_dense() -> None:
    found = []
    for file in FILES:
        for line, rule in sorted(offenders(ast.parse(file.read_text()))):
            found.append(f"{file.relative_to(ROOT)}:{line}: {rule}")
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("source", "rules"),
    [
        ("FLOOR, RIM = 0.0, 1.0", 0),
        ("def f(p):\n    x, y = p", 0),
        ("def f():\n    x, y = 0.0, 1.0", 1),
        ("x = [a for b in c for a in b]", 1),
        ("x = [\n    a\n    for a in c\n]", 1),
        ("x = 1 if y else 2", 0),
        ("f(1 if y else 2, 1 if z else 2)", 1),
        ("def f():\n    a = 1 if y else 2\n    b = 1 if y else 2", 0),
    ],
)
def test_the_rules(source: str, rules: int) -> None:
    assert len(list(offenders(ast.parse(source)))) == rules
