"""docs/metrics.md lists what the learners tell: no tag is missing, none is told by nobody."""

import re
from dataclasses import replace
from typing import Any

import pytest
import torch

from bidex_meta.evaluation.play import ZeroAgent
from bidex_meta.experiments.learners import learner_kind
from bidex_meta.training.learner import Capability, Sources
from bidex_meta.witness.teachers import Teachers, Tutor
from tests.algos.families import PointGoals
from tests.algos.toy import ToyWorld, nearness
from tests.offline.stored import as_data, noisy, played
from tests.pages import ROOT

SMALL: dict[str, Any] = {
    "hidden": (8,), "autocast": "off", "warmup_steps": 2, "batch_size": 16, "updates_per_iteration": 4,
    "vae_hidden": (8,),
}  # fmt: skip
VARIANTS: dict[str, list[dict[str, Any]]] = {
    "mtppo": [
        {}, {"gradient_surgery": "pcgrad"}, {"gradient_surgery": "famo"}, {"demonstration_batch": 32},
        {"teacher_updates": 2},
    ],
    "maml": [{}, {"outer": "adam"}, {"step_sizes": "weight"}], "promp": [{}, {"step_sizes": "layer"}], "mttrpo": [{}],
    **{name: [{}] for name in ("mtsac", "mttd3", "fasttd3", "brc", "flashsac", "ddpg", "rl2", "varibad")},
    **{name: [{}] for name in ("bc", "bcq", "td3bc", "iql")},
    "pearl": [{"steps_per_iteration": 25}], "dagger": [{"teacher_steps": 0}],
    "icl": [{"trials": 32, "memory": 8, "teacher_steps": 0}],
}  # fmt: skip
PLAYING = [algo for algo in VARIANTS if Capability.OFFLINE not in learner_kind(algo).capabilities]
TEAM = {"agents": "a=action/0;b=action/1"}
OF_AGENTS = {"ippo": "mtppo", "mappo": "mtppo", "happo": "mtppo", "hatrpo": "mttrpo", "maddpg": "ddpg"}
"""Learners of several agents, and those whose tags they have."""


def told(algo: str, variants: list[dict[str, Any]]) -> set[str]:
    kind, tags = learner_kind(algo), set()
    for options in variants:
        config = kind.presets["laptop"]
        known = {**SMALL, **options}
        config = replace(config, **{name: value for name, value in known.items() if hasattr(config, name)})
        mode, bandits = kind.learner_class.autoreset_mode(config), [nearness(0.5), nearness(-0.5)]
        if Capability.ADAPTS in kind.capabilities:
            world = PointGoals(16, autoreset_mode=mode)
        else:
            world = ToyWorld(bandits, rows=8)
        sources: dict[str, Any] = {}
        if known.get("demonstration_batch") or Capability.OFFLINE in kind.capabilities:
            data = as_data(played(world, noisy(lambda obs: torch.zeros(len(obs), 2), 0.5), 9))
            sources["data" if Capability.OFFLINE in kind.capabilities else "demonstrations"] = data
        if Capability.TAUGHT in kind.capabilities or known.get("teacher_updates"):
            rows, width = torch.arange(world.num_envs), world.single_observation_space.shape[0]
            sources["teachers"] = Teachers(world, [Tutor(ZeroAgent(world.action_space), rows, width)])
        more = {"sources": Sources(**sources)} if sources else {}
        learner = kind.learner_class(world, config, 0, **more)
        for _ in range(3):
            found = learner.iterate()
        names = "|".join(map(re.escape, world.task_names))
        tags |= {re.sub(rf"/(?:{names})$", "/<task>", tag) for tag in found}
    return tags


def listed() -> dict[str, set[str]]:
    page: dict[str, set[str]] = {algo: set() for algo in VARIANTS}
    text = (ROOT / "docs" / "metrics.md").read_text(encoding="utf-8").partition("## What the run adds")[0]
    for row in re.findall(r"^\| (`.*?) \| (.*?) \|", text, re.MULTILINE):
        groups = {"all": list(VARIANTS), "all that play": PLAYING}
        learners = groups.get(row[1]) or re.findall(r"\w+", row[1])
        for algo in learners:
            page[algo] |= set(re.findall(r"`([^`]+)`", row[0]))
    return page


@pytest.mark.parametrize("algo", VARIANTS)
def test_the_page_has_what_the_learner_tells(algo: str) -> None:
    assert listed()[algo] == told(algo, VARIANTS[algo])


@pytest.mark.parametrize("algo", OF_AGENTS)
def test_learners_of_several_agents_tell_what_their_like_does(algo: str) -> None:
    like = VARIANTS[OF_AGENTS[algo]][0]
    assert told(algo, [like | TEAM]) == told(OF_AGENTS[algo], [like])
