"""Tables and pictures of the ladder, whose suites are ordered by how much of a task they hide.

Meta-learners are compared with a policy that sees neither goal nor rewards, and with a policy that sees the goal.
"""

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.statistics import probability_of_improvement
from bidex_meta.experiments.learners import learner_class
from bidex_meta.runs import plots
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import ClassSummary, Evaluated, MetaTestEvaluation
from bidex_meta.runs.stored import StoredRun
from bidex_meta.suite_files import load_suite, suite_names
from bidex_meta.training.learner import Capability
from tools.pages.studies import Study, refuse_differing
from tools.pages.tables import mean_and_range, table
from tools.pages.validity import share_cell

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BLIND = "blind PPO"
"""Name of MT-PPO on the suite itself, which hides goals and does not show rewards."""
SHOWN = "goal-shown PPO"
"""Name of MT-PPO on the multi-task version of the suite, which shows goals."""
_OWN = "own rewards"
_MARK = " on train tasks"
_HEAD = (
    "learner", "given in training", "seeds", "steps", "minutes", "episodes per shot", "before", "after 1", "after 2",
    "after 2, hidden", "gap closed",
)  # fmt: skip
_VALIDITY = {"blind": "blind at best", "named": "named by its start", "identified": "identified"}
"""Figures of ``bidex-meta validity`` and their headings."""
_GOAL_SHOWN_AT_LEAST = 0.6
_BLIND_AT_MOST = 0.15
_LEAST_GAP = 0.1
"""Smallest gain of goal-shown PPO over blind PPO of which the table says how much a learner closes."""
_PAIRS_AT_LEAST = 3
_SEEDS_AT_LEAST = 3


@dataclass
class Line:
    """The results of one learner on one suite, for each seed."""

    given: str
    shares: list[list[float]] = field(default_factory=list)
    """Mean success over classes after 0, 1, ... exploring episodes, for each seed. PPO has a single number per seed."""
    hidden: list[float] = field(default_factory=list)
    """Success in an episode with hidden rewards after all exploring episodes, for each seed that has such episodes."""
    rollouts: set[int] = field(default_factory=set)
    """Numbers of exploring episodes of a task in one shot; empty if the learner does not explore."""
    runs: list[StoredRun] = field(default_factory=list)
    """The run of each seed."""
    starts: list[StoredRun] = field(default_factory=list)
    """The run whose policy each seed started from; empty if the learner starts from scratch."""
    on_train_tasks: bool = False
    """True if the results are on train tasks although the suite has other test tasks."""

    @property
    def mark(self) -> str:
        """Return the text that follows the success in tables; empty unless the success is on train tasks."""
        return _MARK if self.on_train_tasks else ""

    @property
    def last(self) -> np.ndarray:
        """Return the success after all exploring episodes, (seeds, 1)."""
        return np.array([[each[-1]] for each in self.shares])

    def effort(self, key: str, unit: float, form: str) -> str:
        """Return the mean of an entry of the runs, such as their steps, in units of ``unit``.

        If the learner starts from the policies of other runs, the mean over those comes first: "3,000 + 1,000".
        """
        means = [np.mean([run.content[key] for run in runs]) / unit for runs in (self.starts, self.runs) if runs]
        return " + ".join(format(mean, form) for mean in means)


def ladder_table(*studies: Study) -> Iterator[str]:
    """Yield three items for each suite: a table of learners, a verdict, and a table of pairs of learners.

    The verdict says whether the suite separates the learners; a table of a single split has none. "Gap closed" is a
    learner's success after the last exploring episode on a scale from blind PPO (0 %) to goal-shown PPO (100 %).
    Results are on the test tasks, or on the ``split`` of a study if it has one. Success on train tasks is marked.
    """
    for number, (suite, lines) in enumerate(_suites(studies).items()):
        if number:
            yield ""
        yield from (f"**{suite}**", "")
        rows = [_row(name, line, lines) for name, line in lines.items()]
        yield from table(_HEAD, rows)
        pairs = list(_pairs(lines))
        if not any(study.split for study in studies):
            yield from ("", _verdict(suite, lines, pairs))
        if pairs:
            head = ("first", "second", "probability that the first is better", "p", "separated")
            yield from ("", *table(head, pairs))


def suites_table(*studies: Study) -> Iterator[str]:
    """Yield a table of suites: what ``bidex-meta validity`` measured, and success of two policies.

    The policies are blind PPO, which sees neither goal nor rewards, and goal-shown PPO. The measured figures are means
    over classes, from ``validity/SUITE.json`` next to the folder of data.
    """
    rows = []
    for suite, lines in _suites(studies).items():
        file = studies[0].runs[0].path.parent.parent / "validity" / f"{suite}.json"
        classes = _classes(file)
        hidden = sorted({part for row in classes for part in row["hidden"]})
        cells = [suite, ", ".join(hidden)]
        means = {}
        for figure in (*_VALIDITY, "chance", "explained"):
            known = [row[figure] for row in classes if row.get(figure) is not None]
            means[figure] = float(np.mean(known)) if known else None
        cells += [share_cell(means, figure) for figure in _VALIDITY]
        for name in (BLIND, SHOWN):
            if name in lines:
                line = lines[name]
                cells.append(mean_and_range(100.0 * line.last[:, 0], ".3g", " %") + line.mark)
            else:
                cells.append("")
        rows.append(cells)
    yield from table(("suite", "hidden", *_VALIDITY.values(), BLIND, SHOWN), rows)


def _classes(file: Path) -> list[Json]:
    """Return the rows of a file of ``bidex-meta validity``, or an empty list if there is no such file."""
    if not file.is_file():
        return []
    return list(json.loads(file.read_text())["classes"].values())


def ladder_figure(*studies: Study) -> "Figure":
    """Draw success after each shot: a panel per suite, a line per learner, horizontal lines for PPO.

    Bands show the worst and the best seed. The legend says how many exploring episodes of a task the learner has in a
    shot if it has more than one.
    """
    panels: dict[str, list[plots.Group]] = {}
    suites = _suites(studies)
    labels = _legend(suites.values())
    most = max(len(each) for lines in suites.values() for line in lines.values() for each in line.shares)
    for suite, lines in suites.items():
        panels[suite] = []
        for name, line in lines.items():
            shares = np.array([each * most if len(each) == 1 else each for each in line.shares])
            if len(shares) > 1:
                ends = shares.min(0), shares.max(0)
            else:
                ends = None, None
            panels[suite].append((labels[name], {"success": plots.Curve(np.arange(most), shares.mean(0), *ends)}))
    figure = plots.draw_panels(panels, "success", "success", (1.0, "shots of exploring episodes"))
    for axis in figure.axes:
        axis.set_xticks(range(most))
        axis.set_ylim(-0.02, 1.02)  # shows lines at 0 and at 1
    return figure


def _legend(suites: Iterable[dict[str, Line]]) -> dict[str, str]:
    """Return the label of each learner: its name, and its numbers of exploring episodes in a shot."""
    episodes: dict[str, set[int]] = {}
    for lines in suites:
        for name, line in lines.items():
            episodes.setdefault(name, set()).update(line.rollouts)
    labels = {}
    for name, numbers in episodes.items():
        if max(numbers, default=1) == 1:
            labels[name] = name
        else:
            ends = sorted({min(numbers), max(numbers)})
            labels[name] = f"{name}, {' to '.join(map(str, ends))} episodes per shot"
    return labels


def _suites(studies: Sequence[Study]) -> dict[str, dict[str, Line]]:
    """Group runs by meta suite and learner, and order the learners of each suite.

    Goal-shown PPO comes first, then the other learners by success, and blind PPO last. Raises BidexError if the runs of
    a learner are not seeds of one setting, if only some of them are evaluated on unseen tasks, or if the run is missing
    from whose policy a run started.
    """
    found: dict[str, dict[str, Line]] = {}
    runs = [(study.split or "test", run) for study in studies for run in study.runs]
    played = [pair for pair in runs if isinstance(pair[1].evaluation(), MetaTestEvaluation)]
    classes = {_suite(run): _split(run.evaluation(), split)[0].keys() for split, run in played}
    for split, run in runs:
        suite = _suite(run)
        by_shot = _split(run.evaluation(), split)
        names = [name for name in by_shot[0] if name in classes.get(suite, by_shot[0])]
        if not names:
            continue
        learner, new = _named(run)
        line = found.setdefault(suite, {}).setdefault(learner, new)
        on_train_tasks = _on_train_tasks(run)
        if line.shares and on_train_tasks != line.on_train_tasks:
            raise BidexError(
                f"Expected unseen tasks in the evaluations of all runs of {learner} on {suite}, but some are only on "
                "train tasks. Evaluate those with --other-tasks, and collect them again."
            )
        line.on_train_tasks = on_train_tasks
        line.runs.append(run)
        line.starts += _start(run, [other for _, other in runs])
        line.shares.append([float(np.mean([shot[name].success for name in names])) for shot in by_shot])
        evaluation = run.evaluation()
        if isinstance(evaluation, MetaTestEvaluation):
            line.rollouts.add(_episodes_per_shot(run, evaluation, split))
            if shots := evaluation.splits[split].hidden_by_shot:
                line.hidden.append(float(np.mean([shots[-1].classes[name].success for name in names])))
    for suite, lines in found.items():
        for learner, line in lines.items():
            refuse_differing(f"{learner} on {suite}", line.runs)
    return {suite: dict(sorted(lines.items(), key=_place)) for suite, lines in sorted(found.items())}


def _start(run: StoredRun, runs: Sequence[StoredRun]) -> list[StoredRun]:
    """Return the run among ``runs`` from whose policy a run started; an empty list if it started from scratch."""
    name = run.config().start_from
    if name is None:
        return []
    found = [other for other in runs if other.content["name"] == name]
    if not found:
        raise BidexError(f"{run.content['name']} started from the policy of {name}. Collect that run too.")
    return found[:1]


def _suite(run: StoredRun) -> str:
    """Return the meta suite to which a run belongs; for a multi-task suite, the meta suite with the same goals."""
    return "ML" + str(run.content["suite"]["name"]).removeprefix("ML").removeprefix("MT")


def _named(run: StoredRun) -> tuple[str, Line]:
    """Return the name of a run's learner in the tables, and the line of this learner, still without results."""
    algo = run.config().algo
    if algo != "mtppo":
        return run.arm, Line(", ".join(learner_class(algo).privileges) or _OWN)
    if str(run.content["suite"]["name"]).startswith("MT"):
        return SHOWN, Line("the goal")
    return BLIND, Line(_OWN)


def _split(evaluation: Evaluated, split: str) -> list[dict[str, ClassSummary]]:
    """Return the results by class after 0, 1, ... exploring episodes.

    PPO does not explore and has a single entry: the results on unseen tasks if PPO was evaluated on them, otherwise the
    results on its own tasks.
    """
    if isinstance(evaluation, MetaTestEvaluation):
        return [shot.classes for shot in evaluation.splits[split].by_shot]
    unseen = evaluation.other_tasks
    return [evaluation.policy.classes if unseen is None else unseen.policy.classes]


def _episodes_per_shot(run: StoredRun, evaluation: MetaTestEvaluation, split: str) -> int:
    """Return the number of exploring episodes from which a learner adapts to a task in one shot.

    Environments of a task share their episodes, unless the learner adapts in each environment separately.
    """
    if Capability.ADAPTS_INDEPENDENTLY in learner_class(run.config().algo).capabilities:
        return 1
    return evaluation.splits[split].rollouts


def _on_train_tasks(run: StoredRun) -> bool:
    """Return whether :func:`_split` takes a run's results on train tasks although its suite has other test tasks."""
    evaluation = run.evaluation()
    if isinstance(evaluation, MetaTestEvaluation) or evaluation.other_tasks is not None:
        return False
    return not _tests_train_tasks(run.content["suite"])


def _tests_train_tasks(suite: Json) -> bool:
    """Return whether all classes of a suite list the same tasks for training and for testing.

    The result is False if the suite is not a shipped one.
    """
    if "file" in suite or suite["name"] not in suite_names():
        return False
    for entry in load_suite(suite["name"]).classes:
        trained = [task for task in entry.tasks if task.of("train")]
        tested = [task for task in entry.tasks if task.of("test")]
        if not tested or trained != tested:
            return False
    return True


def _place(item: tuple[str, Line]) -> tuple[int, float]:
    name, line = item
    return {SHOWN: 0, BLIND: 2}.get(name, 1), -float(line.last.mean())


def _row(name: str, line: Line, lines: dict[str, Line]) -> list[str]:
    shares = [mean_and_range(100.0 * np.array(each), ".3g", " %") for each in zip(*line.shares, strict=True)]
    shown = [share + line.mark for share in shares]
    shown += [""] * (3 - len(shown))
    if line.hidden:
        shown.append(mean_and_range(100.0 * np.array(line.hidden), ".3g", " %"))
    else:
        shown.append("")
    closed = ""
    if SHOWN in lines and BLIND in lines and name not in (SHOWN, BLIND):
        low = lines[BLIND].last.mean()
        gap = lines[SHOWN].last.mean() - low
        if gap > _LEAST_GAP:
            closed = mean_and_range(100.0 * (line.last[:, 0] - low) / gap, ".0f", " %")
    steps = line.effort("steps", 1.0, ",.0f")
    minutes = line.effort("seconds", 60.0, ".0f")
    rollouts = ", ".join(map(str, sorted(line.rollouts)))
    return [name, line.given, str(len(line.shares)), steps, minutes, rollouts, *shown, closed]


def _pairs(lines: dict[str, Line]) -> Iterator[list[str]]:
    """Yield a row for each pair of reward-only meta-learners with enough seeds.

    The first learner is separated from the second if its worst seed is better than the second learner's best seed.
    """
    judged = [name for name, line in lines.items() if len(line.shares) >= _SEEDS_AT_LEAST]
    learners = [name for name in judged if lines[name].given == _OWN and name != BLIND]
    for first, second in combinations(learners, 2):
        one = lines[first].last
        other = lines[second].last
        better = probability_of_improvement(one, other)
        apart = bool(one.min() > other.max())
        yield [first, second, f"{better:.2f}", f"{_exact_p(one, other):.2f}", "yes" if apart else "no"]


def _exact_p(one: np.ndarray, other: np.ndarray) -> float:
    """Return the exact two-sided p of a permutation test on the probability of improvement.

    It is the share of divisions of all runs into two groups, of the sizes of ``one`` and ``other``, that differ at
    least as much. Bootstrap intervals over three runs would contain the true probability in only about 60 % of cases.
    """
    runs = np.concatenate((one, other))
    places = range(len(runs))
    found = []
    for chosen in combinations(places, len(one)):
        rest = [place for place in places if place not in chosen]
        found.append(abs(probability_of_improvement(runs[list(chosen)], runs[rest]) - 0.5))
    observed = abs(probability_of_improvement(one, other) - 0.5)
    return float(np.mean(np.array(found) >= observed - 1e-9))


def _verdict(suite: str, lines: dict[str, Line], pairs: Sequence[Sequence[str]]) -> str:
    """Return a sentence that says whether the suite meets the ladder's rule for good suites, and if not, why."""
    if SHOWN not in lines or BLIND not in lines:
        return "We do not yet judge whether this suite is good, because blind or goal-shown PPO is missing."
    if (seeds := min(len(line.shares) for line in lines.values())) < _SEEDS_AT_LEAST:
        return (
            f"We do not yet judge whether this suite is good: that needs {_SEEDS_AT_LEAST} seeds of every learner, and "
            f"some learners have {seeds}."
        )
    reasons = []
    shown = float(lines[SHOWN].last.mean())
    blind = float(lines[BLIND].last.mean())
    choices = re.search(r"choice(\d)$", suite)
    if choices is None:
        most = _BLIND_AT_MOST
    else:
        most = 1.0 / int(choices[1])
    if shown < _GOAL_SHOWN_AT_LEAST:
        reasons.append(f"goal-shown PPO reaches {shown:.0%}, and {_GOAL_SHOWN_AT_LEAST:.0%} is required")
    if blind > most:
        reasons.append(f"blind PPO reaches {blind:.0%}, at most {most:.0%} is allowed")
    separated = sum(pair[-1] == "yes" for pair in pairs)
    if separated < _PAIRS_AT_LEAST:
        reasons.append(f"{separated} pairs of reward-only learners are separated, and {_PAIRS_AT_LEAST} are required")
    if not reasons:
        return (
            f"This suite meets the criteria below. In {separated} pairs of learners that see only rewards, the worst "
            "seed of one learner is better than the best seed of the other."
        )
    return f"The suite does not yet meet the criteria for a good suite, defined below: {'; '.join(reasons)}."
