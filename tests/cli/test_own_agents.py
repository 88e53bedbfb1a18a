"""``meta_test`` of an agent that is no run, on points in the plane, and its entry on the leaderboard."""

import json
import threading
from pathlib import Path
from typing import ClassVar

import pytest
import torch

from bidex_meta import BidexError, load_suite, meta_test
from bidex_meta.agents import TrialAgent
from bidex_meta.evaluation.entries import AgentEntry
from bidex_meta.evaluation.leaderboard import read_entry
from bidex_meta.evaluation.trial_agents import AdaptingTrialAgent
from bidex_meta.runs.evaluations import read_evaluation
from bidex_meta.suite import Suite
from bidex_meta.worlds.own import OwnSuite
from tests.cli.conftest import COUNTS
from tests.points import SPEED, Finder
from tools.pages.leaderboard import leaderboard_table

pytestmark = pytest.mark.usefixtures("finder")
SMALL = {"split": "test", "rollouts": 2, "device": "cpu"}


class Constant:
    """Acts in one way and learns nothing; ``calls`` are those of all copies."""

    calls: ClassVar[list[str]] = []

    def reset(self, env_mask: torch.Tensor) -> None:
        assert env_mask.all()
        self.calls.append("reset")

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        self.calls.append("act")
        return torch.full((len(obs), 2), 0.1)

    def observe(self, timestep: object) -> None:
        self.calls.append("observe")


class Scout(Constant):
    """Goes ahead in its first episode, each environment in its own direction, then to the best place of the trial."""

    def reset(self, env_mask: torch.Tensor) -> None:
        self.place = torch.zeros(len(env_mask), 2)
        self.reward = torch.full((len(env_mask),), -torch.inf)
        self.knows = torch.zeros_like(env_mask)

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        angle = torch.arange(len(obs)) * 2.399
        ahead = torch.stack([angle.cos(), angle.sin()], 1)
        return torch.where(self.knows[:, None], ((self.place - obs[:, :2]) / SPEED).clamp(-1, 1), ahead)

    def observe(self, timestep) -> None:
        better = timestep.valid & (timestep.reward > self.reward) & ~self.knows
        self.reward = torch.where(better, timestep.reward, self.reward)
        self.place = torch.where(better[:, None], timestep.next_observation[:, :2], self.place)
        self.knows = self.knows | timestep.terminated | timestep.truncated


class Silent:
    """Has no ``observe``."""

    def reset(self, env_mask: torch.Tensor) -> None: ...
    def act(self, obs: torch.Tensor) -> torch.Tensor:
        return torch.zeros(len(obs), 2)


class Locked(Constant):
    """Cannot be copied."""

    def __init__(self) -> None:
        self.lock = threading.Lock()


class Wide(Constant):
    """Has an action too many."""

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        return torch.zeros(len(obs), 3)


def test_an_agent_that_learns_nothing_gains_exactly_0_and_calls_come_in_order() -> None:
    Constant.calls.clear()
    agent = Constant()
    assert isinstance(agent, TrialAgent)
    gains = meta_test(agent, "ML4", **SMALL).splits["test"].gains()
    for measure in ("return", "success"):
        gain = gains.aggregate[measure]
        assert gain is not None and (gain.value, gain.interval) == (0.0, (0.0, 0.0))
    episode = ["act", "observe"] * 8
    assert Constant.calls == ["reset", *episode * 5], "one trial: judged, explored, judged, explored, judged"


def test_exploring_helps_and_the_agent_itself_learns_nothing() -> None:
    agent = Scout()
    found = meta_test(agent, "ML4", tasks=2, hidden_rewards=True, **SMALL)
    assert (found.algo, found.run, found.steps) == ("Scout", None, None) and not vars(agent)
    gain = found.splits["test"].gains().aggregate["return"]
    assert gain is not None and gain.interval is not None and gain.interval[0] > 0
    assert meta_test(agent, "ML4", tasks=2, hidden_rewards=True, **SMALL).to_json() == found.to_json()


def test_an_agent_with_the_calls_of_a_learner_shares_what_it_finds() -> None:
    found = meta_test(Finder(), "ML4", split="train", device="cpu", tasks=1, trials=2, rollouts=6, num_envs=8)
    part = found.splits["train"]
    assert part.rollouts == 6, "more rollouts than environments of a task take several rounds"
    gain = part.gains().aggregate["return"]
    assert gain is not None and gain.value > 0
    alone = meta_test(AdaptingTrialAgent(Scout()), "ML4", split="train", device="cpu", rollouts=6, num_envs=8)
    assert list(alone.splits) == ["train"] and list(alone.splits["train"].after.classes) == list(COUNTS["train"])


class Ending(Constant):
    """Tries to end every episode."""

    def observe(self, timestep) -> None:
        for flags in (timestep.truncated, timestep.terminated, timestep.valid):
            flags.fill_(True)


def test_an_agent_cannot_end_episodes() -> None:
    ending, other = (meta_test(agent, "ML4", **SMALL).to_json()["splits"] for agent in (Ending(), Constant()))
    assert ending == other


class Drawing(Finder):
    """Draws its exploring actions from one generator, which ``init`` does not restart."""

    def __init__(self) -> None:
        super().__init__()
        self.generator = torch.Generator().manual_seed(0)

    def adapt_action(self, obs: torch.Tensor) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        return torch.rand(len(obs), 2, generator=self.generator), {}


def test_what_an_agent_does_on_one_split_does_not_change_the_other() -> None:
    size = {"device": "cpu", "tasks": 1, "rollouts": 2}
    agent = Drawing()
    both = meta_test(agent, "ML4", **size).to_json()["splits"]
    assert both["test"] == meta_test(agent, "ML4", split="test", **size).to_json()["splits"]["test"]


def test_the_file_is_read_again_and_is_no_run_s(tmp_path: Path, adapted: Path, refused) -> None:
    path = tmp_path / "result.json"
    found = meta_test(Scout(), "ML4", task_seed=3, **SMALL)
    found.save(path)
    stored = json.loads(path.read_text())
    assert stored == json.loads(json.dumps(found.to_json())) and read_evaluation(path, "again") == found.record()
    assert (stored["agent"], stored["suite"], stored["task_seed"], "run" in stored) == ("Scout", "ML4", 3, False)
    assert stored["conditions"]["suite_digest"] == load_suite("ML4").digest
    assert "got that of the agent Scout" in refused("verify", adapted, "--evaluation", path)
    for given in ({"suite": "ML4"}, {"task_seed": 1}):
        with pytest.raises(BidexError, match=f"{next(iter(given))}: a run has its own, got .* Leave"):
            meta_test(adapted, **given)


@pytest.mark.parametrize(
    ("agent", "suite", "options", "expected"),
    [
        (Silent(), "ML4", {}, "meta_test: agent: expected .* a TrialAgent .*, which has no observe"),
        (Constant(), None, {}, "suite: expected the suite to play"),
        (Constant(), "MT4", {}, "Constant adapts to hidden goals, but MT4 shows them"),
        (Constant(), "ML5", {}, "ML5"),
        (Constant(), "ML4", {"save": True}, r"call result\.save\(path\)"),
        (Wide(), "ML4", {}, "Expected actions of shape"),
        (Locked(), "ML4", {}, "copy.deepcopy can copy, got a Locked: .*lock"),
        ("runs/r", "ML4", {}, "runs/r is not a run folder"),
    ],
)
def test_refusals_are_one_line(agent, suite, options, expected) -> None:
    with pytest.raises(BidexError, match=expected) as raised:
        meta_test(agent, suite, **SMALL, **options)
    assert "\n" not in str(raised.value)


@pytest.fixture
def result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file of a meta-test whose classes are those of the suite."""
    pools = {split: {"TwoCatchUnderarm": [""] * counts["Near"]} for split, counts in COUNTS.items()}
    monkeypatch.setattr(Suite, "task_names", lambda suite, split: pools[split])
    monkeypatch.setattr(OwnSuite, "tasks", lambda source, split: pools[split])
    made = OwnSuite.world

    def renamed(*given):
        world = made(*given)
        world.task_names = ["TwoCatchUnderarm"]
        return world

    monkeypatch.setattr(OwnSuite, "world", renamed)
    path = tmp_path / "result.json"
    meta_test(Scout(), "ML4", **SMALL).save(path)
    return path


def test_a_submitted_agent_is_not_verified_and_says_how_it_was_trained(result: Path, shown, refused) -> None:
    out = result.parent / "leaderboard"
    words = ["submit", "--evaluation", result, "--out", out, "--name", "scout"]
    assert "--tuning: expected the number" in refused(*words, "--track", "reward-only")
    words += ["--tuning", "3x1"]
    assert "--track: expected reward-only" in refused(*words)
    assert "not verified" in shown(*words, "--track", "reward-only")
    entry = read_entry(out / "trials" / "ML4-scout.json")
    assert isinstance(entry, AgentEntry) and not entry.verified
    assert (entry.name, entry.track, entry.agent, entry.tuning.trials) == ("scout", "reward-only", "Scout", 3)
    title, _, head, _, row, *_ = leaderboard_table("ML4", result.parent / "data")
    assert title == "**ML4, adaptation, reward only**" and "after 2" in head
    assert row.startswith("| 1 | scout (not verified) |") and "| 3 × 1 |" in row
    assert "exists already" in refused(*words, "--track", "privileged")
    assert "got both" in refused(*words, result.parent, "--track", "privileged")
    assert not list(leaderboard_table("ML1", result.parent / "data"))


EDITS = {
    "a run's": lambda found: found.pop("agent"),
    "success above 1": lambda found: found["splits"]["test"]["by_shot"][2]["classes"]["TwoCatchUnderarm"].update(
        success=1.5
    ),
    "another mean": lambda found: found["splits"]["test"]["by_shot"][2]["classes"]["TwoCatchUnderarm"].update(
        success=0.123
    ),
    "no single tasks": lambda found: found["splits"]["test"]["by_shot"][2]["classes"]["TwoCatchUnderarm"].pop("solved"),
    "randomised": lambda found: found.update(randomisation={"friction": 0.1}),
    "another suite": lambda found: found["conditions"].update(suite_digest="0" * 12),
    "no test tasks": lambda found: found["splits"].update(train=found["splits"].pop("test")),
    "a suite of one's own": lambda found: found.update(suite="mine"),
    "fewer shots": lambda found: found["splits"]["test"]["by_shot"].pop(),
}


@pytest.mark.parametrize("edit", EDITS)
def test_another_evaluation_is_refused(edit: str, result: Path, refused) -> None:
    found = json.loads(result.read_text())
    EDITS[edit](found)
    result.write_text(json.dumps(found))
    told = refused("submit", "--evaluation", result, "--track", "privileged", "--out", result.parent, "--tuning", "1x1")
    assert str(result) in told and len(told.splitlines()) == 1
