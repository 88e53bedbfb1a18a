"""Suites: their contents, the rules of versions, and the files that ship with the package."""

from bidex_meta.suite.contents import (
    FACTORS,
    MOST_POINTS,
    OTHER_SEED,
    OTHERS,
    SPLITS,
    ListedTask,
    Randomisation,
    Split,
    Suite,
    SuiteClass,
)
from bidex_meta.suite.loading import (
    METAWORLD_SUITES,
    file_names,
    load_randomisation,
    load_suite,
    metaworld_classes,
    suite_names,
)
from bidex_meta.suite.rules import HELD_STEPS, V1, V2, Rules, plain_name, rules_apart, versioned_name

__all__ = [
    "FACTORS", "HELD_STEPS", "METAWORLD_SUITES", "MOST_POINTS", "OTHERS", "OTHER_SEED", "SPLITS", "V1", "V2",
    "ListedTask", "Randomisation", "Rules", "Split", "Suite", "SuiteClass", "file_names", "load_randomisation",
    "load_suite", "metaworld_classes", "plain_name", "rules_apart", "suite_names", "versioned_name",
]  # fmt: skip
