"""Rows of the tables that ``bidex-meta list`` prints: task classes, what tasks hide, learners and objects.

Task classes and learners are read from their source code, so that their rows need neither torch nor MuJoCo.
"""

import ast
import importlib.util
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from bidex_meta.errors import BidexError
from bidex_meta.experiments.learners import ALGOS
from bidex_meta.tasks import registry
from bidex_meta.utils.files import JsonObject as Json


def task_rows() -> list[Json]:
    """Return the rows of ``bidex-meta list tasks``, one per task class: its sizes, episode length and summary."""
    rows = []
    for name in registry.names():
        place = registry.module_of(name), name
        moves, steps, summary = (_constant(*place, key) for key in ("moves_by_default", "episode_steps", "summary"))
        found = re.findall(r"\((\d{3})[;)]", _docstring(*place))
        if len(found) != 1:
            raise BidexError(
                f"{name}: expected the observation's size once in the docstring, as in 'Observation: Table 10 (422).', "
                f"got {found}."
            )
        sizes = {"observation": int(found[0]), "action": 52 if moves else 40}
        rows.append({"name": name, **sizes, "episode_steps": steps, "summary": summary})
    return rows


def hidden_rows() -> list[Json]:
    """Return the rows of ``bidex-meta list hidden``, one per task class of version 2.

    A row lists the parts of a task, such as its goal, that observations do not show.
    """
    tasks = [registry.get(f"{name}-v2") for name in registry.names()]
    return [{"name": t.name, "hides": [part.described(t.variation_space) for part in t.hides()]} for t in tasks]


def algo_rows() -> list[Json]:
    """Return the rows of ``bidex-meta list algos``, one per learner: its name, presets and summary."""
    rows = []
    for name, path in ALGOS.items():
        module, _, class_name = path.partition(":")
        presets = _keys(*_attribute(module, class_name, "presets")) or _keys(*_found(module, "PRESETS"))
        rows.append({"name": name, "presets": presets, "summary": _docstring(module, class_name).splitlines()[0]})
    return rows


# Classes are read from their source code, because their modules load torch and mujoco.


@cache
def _statements(module: str) -> dict[str, ast.AST]:
    spec = importlib.util.find_spec(module)
    assert spec is not None and spec.origin is not None
    return _bound(ast.parse(Path(spec.origin).read_bytes()).body)


def _bound(body: Sequence[ast.stmt]) -> dict[str, ast.AST]:
    """Map each name that ``body`` binds to its class or value, or to the import that it comes from."""
    found: dict[str, ast.AST] = {}
    for node in body:
        match node:
            case ast.ClassDef():
                found[node.name] = node
            case ast.ImportFrom():
                found |= dict.fromkeys((each.name for each in node.names), node)
            case ast.Assign(targets=[ast.Tuple(elts=names)], value=ast.Tuple(elts=values)):
                found |= {ast.unparse(name): value for name, value in zip(names, values, strict=True)}
            case ast.Assign(targets=[ast.Name(name)]) | ast.AnnAssign(target=ast.Name(name)) if node.value:
                found[name] = node.value
            case _:
                pass
    return found


def _found(module: str, name: str) -> tuple[str, ast.AST | None]:
    """Follow imports of a name; return the module that binds the name, and the bound class or value."""
    node = _statements(module).get(name)
    if isinstance(node, ast.ImportFrom):
        return _found(node.module or "", name)
    return (module, node)


def _docstring(module: str, name: str) -> str:
    node = _found(module, name)[1]
    if isinstance(node, ast.ClassDef):
        return ast.get_docstring(node) or ""
    return ""


def _attribute(module: str, name: str, attribute: str) -> tuple[str, ast.AST | None]:
    """Return module and value of a class attribute, which may be inherited from the nearest base class that has it."""
    module, node = _found(module, name)
    if not isinstance(node, ast.ClassDef):
        return module, None
    if own := _bound(node.body).get(attribute):
        return module, own
    bases = (_attribute(module, base.id, attribute) for base in node.bases if isinstance(base, ast.Name))
    return next((found for found in bases if found[1]), (module, None))


def _constant(module: str, name: str, attribute: str) -> object:
    value = _attribute(module, name, attribute)[1]
    if isinstance(value, ast.Constant):
        return value.value
    return None


def _keys(module: str, node: ast.AST | None) -> list[str]:
    """Return the keys of a dictionary literal, a named dictionary, or a union of dictionaries."""
    match node:
        case ast.Dict(keys):
            return [key.value for key in keys if isinstance(key, ast.Constant) and isinstance(key.value, str)]
        case ast.BinOp(left, _, right):
            return list(dict.fromkeys([*_keys(module, left), *_keys(module, right)]))
        case ast.Name(name):
            return _keys(*_found(module, name))
        case _:
            return []


def object_rows() -> list[Json]:
    """Return the rows of ``bidex-meta list objects``, one per object that the throwing classes throw.

    A row has the object's mass (g), the size of its bounding box (mm) and the number of its geoms.
    """
    from bidex_meta.tasks.objects.held import held_object, shelf

    # docs/figures.md lists the sources of the egg's figures.
    rows: list[Json] = [{"name": "egg", "mass_g": 75.4, "box_mm": "60 x 60 x 80", "geoms": 1}]
    for name in shelf():
        if found := held_object(name):
            box = " x ".join(f"{1000 * (high - low):.0f}" for low, high in zip(found.low, found.high, strict=True))
            rows.append({"name": name, "mass_g": round(1000 * found.mass, 1), "box_mm": box, "geoms": found.geoms})
    return rows
