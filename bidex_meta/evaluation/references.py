"""Reference returns, which define the score of version 1 and the return of episodes with broken physics.

References were measured with moving hand bases, as in every suite. ``assets/references/`` holds mean returns of random
actions, zero actions, experts (the best known policies), recorded reference solutions in open-loop replay (called
``witness``) and scripted policies; entries of version 2 end in ``-v2``. In version 1 the better of random and zero
actions scores 0. ``python -m tools.experts`` writes the returns of experts. ``bidex-meta baseline`` measures the
others. In version 2 the reward of a step is in [0, 1], so the score needs no references.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypedDict

import msgspec
import numpy as np

from bidex_meta.errors import BidexError
from bidex_meta.rules import V2, plain_name, versioned_name
from bidex_meta.runs.atomic import Json, write_json
from bidex_meta.runs.evaluations import ClassSummary
from bidex_meta.runs.folder import AnyConfig
from bidex_meta.suite_files import load_suite
from bidex_meta.utils import paths
from bidex_meta.utils.files import exists, read_json
from bidex_meta.utils.validation import Finite, parse

if TYPE_CHECKING:
    from bidex_meta.tasks.base import TaskClass

Kind = Literal["random", "zero", "expert", "witness", "script"]
_Row = TypedDict("_Row", {"return": Finite})


class _File(TypedDict):
    classes: dict[str, _Row]


@dataclass(frozen=True)
class Reference:
    """Mean returns of baseline and expert policies in a class, and what else defines its score."""

    random: float | None  # mean return of uniform actions; None if unknown
    expert: float | None = None  # mean return of the best known policy; None if no policy is above the floor
    zero: float | None = None  # mean return of zero actions; None if unknown
    episode_steps: int | None = None  # steps of a full episode, if the reward of a step is in [0, 1]

    @property
    def floor(self) -> float | None:
        """Return the floor: the better return of random actions and zero actions, which gets the score 0."""
        if self.zero is None or self.random is None:
            return self.random
        return max(self.random, self.zero)

    def scores(self, returns: np.ndarray) -> np.ndarray | None:
        """Return the scores of ``returns``, which are sums of the unscaled reward.

        In version 2 a score is 100 times the mean reward per step of a full episode. In version 1 it is the normalised
        return, 100 · (R − R_floor) / (R_expert − R_floor). The result is None in version 1 if a reference is unknown or
        the expert's return is not greater than the floor.
        """
        if self.episode_steps is not None:
            return 100 * returns / self.episode_steps
        if self.expert is None or self.floor is None or self.expert <= self.floor:
            return None
        return 100 * (returns - self.floor) / (self.expert - self.floor)


def counted_returns(
    returns: np.ndarray, broken: np.ndarray, reference: Reference | None, finished: np.ndarray
) -> np.ndarray:
    """Correct the returns (episodes,) of a class's episodes so that breaking physics gains nothing.

    A ``broken`` episode (bool) ends early, which would be an advantage if rewards are negative. Such an episode
    therefore counts with the return of random actions. If the return of random actions is unknown, the episode counts
    with the return of the worst ``finished`` episode (n,) of this policy and of the policies that are compared with it.
    An episode whose own return is lower keeps its own return.
    """
    if reference is None or reference.random is None:
        others = finished
    else:
        others = np.array([reference.random])
    bound = others.min() if len(others) else np.inf
    return np.where(broken, np.minimum(returns, bound), returns)


def load(kind: Kind) -> dict[str, Json]:
    """Read, for each class, the installed reference return of one kind of policy, such as scripted policies.

    A class has an entry like ``{"return": 0.49, "source": ...}``. The dict is empty if the file does not exist.
    """
    return load_from(paths.assets_dir() / "references" / f"{kind}.json")


def store(path: Path, classes: dict[str, Json], made: Json) -> None:
    """Write references (``return`` and other measures, by class); the file's references of other classes are kept.

    ``made`` describes the measurement and is stored with each class. Raises BidexError if the file does not hold
    references.
    """
    known = load_from(path)
    for name, numbers in classes.items():
        known[name] = {**numbers, "made": made}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"classes": dict(sorted(known.items()))})


def load_from(path: Path) -> dict[str, Json]:
    """Read the references in a file by class; return an empty dict without a file.

    Raises BidexError if the file does not hold references.
    """
    if not exists(path):
        return {}
    try:
        content = read_json(path, "references")
        parse(content, _File, str(path))
    except BidexError as error:
        raise BidexError(f"{error} Expected a file of references or none: name another file.") from None
    return content["classes"]


def references() -> dict[str, Reference]:
    """Return the installed reference returns of each class for which a return of random actions is stored.

    An expert return is left out unless it is greater than the floor, the better return of random and zero actions.
    """
    experts = _returns("expert")
    zero = _returns("zero")
    known = {}
    for name, random in _returns("random").items():
        reference = Reference(random, zero=zero.get(name))
        expert = experts.get(name)
        if expert is not None and reference.floor is not None and expert > reference.floor:
            reference = replace(reference, expert=expert)
        known[name] = reference
    return known


def _returns(kind: Kind) -> dict[str, float]:
    return {name: row["return"] for name, row in load(kind).items()}


def references_of(world: object) -> dict[str, Reference]:
    """Return the references of a world's classes, as ``references_for`` does; empty for other libraries' classes."""
    return references_for({slot.name.partition("/")[0]: slot.task_class for slot in getattr(world, "slots", ())})


def references_for(classes: "Mapping[str, TaskClass]") -> dict[str, Reference]:
    """Return the references that apply to classes, by the names that ``classes`` gives them.

    Stored returns do not apply if the bases of any class are fixed, or to rules other than those of versions 1 and 2.
    """
    known = references()
    moving = all(task.moving_base for task in classes.values())
    found: dict[str, Reference] = {}
    for name, task in classes.items():
        reference = None
        if moving and (task.rules == V2 or task.rules.as_printed):
            reference = known.get(versioned_name(name, task.rules))
        if task.rules.reward == "v2":
            reference = replace(reference or Reference(None), episode_steps=task.episode_steps)
        if reference is not None:
            found[name] = reference
    return found


def rescored(classes: dict[str, ClassSummary], config: AnyConfig) -> dict[str, ClassSummary]:
    """Compute the normalised scores in an evaluation's results again, from the installed reference returns.

    This makes the scores of different runs comparable. Scores of version 2 need no references and do not change.
    References hold only for moving hand bases. The bases are known to have moved if the run's config says so, or if any
    class has a score already. Otherwise all results are returned unchanged.
    """
    if version_of(config, classes) == 2:
        return classes
    if config.base != "moving" and all(row.score is None for row in classes.values()):
        return classes
    known = references()
    rows = dict(classes)
    for name in [name for name in classes if name in known]:
        scores = known[name].scores(np.array([classes[name].mean_return]))
        rows[name] = msgspec.structs.replace(classes[name], score=None if scores is None else float(scores[0]))
    return rows


def version_of(config: AnyConfig, classes: Mapping[str, ClassSummary]) -> int:
    """Return 2 if a run has the reward of version 2, whose success and score mean something else; otherwise 1.

    The name of the run's suite or class decides. A suite without a file here has version 2 if its results have
    ``episode_steps``.
    """
    is_second = any(row.episode_steps is not None for row in classes.values())
    if config.suite is None:
        is_second |= config.task != plain_name(config.task or "")
    else:
        with suppress(BidexError):  # suites of Meta-World have no file, and the user's may be missing
            is_second |= load_suite(config.suite).rules.reward == "v2"
    return 1 + is_second
