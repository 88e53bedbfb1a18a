"""Find the worlds that a config names, without loading torch and physics."""

from collections.abc import Mapping
from itertools import chain

from bidex_meta.errors import BidexError
from bidex_meta.ladder import RUNGS, rung_of
from bidex_meta.rules import plain_name
from bidex_meta.suite import SPLITS
from bidex_meta.suite_files import METAWORLD_SUITES, known_suite, load_suite, suite_names
from bidex_meta.tasks import registry
from bidex_meta.utils.files import Json
from bidex_meta.worlds.base import Worlds, WorldsConfig
from bidex_meta.worlds.external import HUMANOID, HumanoidTask, MetaWorldSuite
from bidex_meta.worlds.own import OwnSuite, SingleClass


def open_worlds(config: Mapping[str, Json] | WorldsConfig) -> Worlds:
    """Return the worlds of a config's ``suite`` or class ``task``, whose names may be in upper or lower case.

    Raises BidexError if the suite or class is unknown or faulty.
    """
    config = WorldsConfig.of(config)
    if config.suite is None:
        return _class_worlds(config.task or "", config)
    suite = config.suite
    if not suite.endswith(".toml"):
        if plain_name(suite) in registry.names():
            raise BidexError(f"{suite} is a class, not a suite: name it by task (--task {suite}).")
        suite = known_suite(suite, METAWORLD_SUITES)
    if suite in METAWORLD_SUITES:
        return MetaWorldSuite(suite, config)
    return OwnSuite(suite, config)


def _class_worlds(task: str, config: WorldsConfig) -> Worlds:
    if task.casefold() == HUMANOID.casefold():
        return HumanoidTask(HUMANOID, config)
    if task in suites_to_run():
        raise BidexError(f"{task} is a suite, not a class: name it by suite (--suite {task}).")
    return SingleClass(registry.resolve(task, "task"), config)


def suites_to_run() -> list[str]:
    """Return every suite that a config may name: the shipped ones and Meta-World's."""
    return [*suite_names(), *METAWORLD_SUITES]


def listed() -> list[dict[str, object]]:
    """Return the entries of ``bidex-meta list suites``.

    Our suites come first, then Meta-World's. The suites of the ladder come last, sorted by rung, that is, by how much
    they hide.
    """
    rows: list[dict[str, object]] = []
    ladder: list[list[dict[str, object]]] = [[] for _ in RUNGS]
    for suite in map(load_suite, suite_names()):
        train, test = ([entry.name for entry in suite.split_classes(split)] for split in SPLITS)
        row = _listed(suite.name, suite.kind, train, test, suite.description)
        rung = rung_of(suite.name, train)
        if rung is None:
            rows.append(row)
        else:
            hidden, budget = RUNGS[rung]
            ladder[rung].append(row | {"rung": rung, "hidden": hidden, "needs": budget})
    summary = "Meta-World's own environments, to run our learners on (only run and evaluate know them)"
    rows += [_listed(name, "multi-task", list(classes), [], summary) for name, classes in METAWORLD_SUITES.items()]
    return [*rows, *chain.from_iterable(ladder)]


def _listed(name: str, kind: str, train: list[str], test: list[str], summary: str) -> dict[str, object]:
    """Return an entry of the list for a suite that is not on the ladder."""
    classes = {"train_classes": train, "test_classes": test}
    return {"name": name, "kind": kind, **classes, "rung": None, "hidden": None, "needs": None, "summary": summary}
