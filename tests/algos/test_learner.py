"""Beginning with another run's policy: it acts as that one did, and what does not fit is refused."""

from dataclasses import replace

import pytest
import torch

from bidex_algos.meta.maml import PRESETS as MAML_PRESETS
from bidex_algos.meta.promp import PRESETS as PROMP_PRESETS
from bidex_algos.meta.promp import ProMP, ProMPConfig
from bidex_algos.offpolicy.mtsac import MTSAC, MTSACConfig
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_algos.onpolicy.mtppo import PRESETS as PPO_PRESETS
from bidex_meta.errors import BidexError
from tests.algos import problems
from tests.algos.families import PointGoals

PPO = MTPPOConfig(hidden=(8,), rollout_steps=4, activation="tanh", autocast="off")
PROMP = ProMPConfig(hidden=(8,), activation="tanh", tasks_per_class=4)


def trained():
    return problems.trained(MTPPO, PointGoals(rows=16, autoreset_mode="SAME_STEP"), PPO, 3)


def test_a_meta_learner_acts_as_the_policy_it_starts_from_and_learns_on():
    given = trained()
    learner = ProMP(PointGoals(rows=16), PROMP, seed=0)
    obs, _ = learner.world.reset(seed=9)
    assert not torch.allclose(learner.eval_action(obs), given.eval_action(obs))
    learner.start_from(given.policy_state_dict())
    assert torch.equal(learner.eval_action(obs), given.eval_action(obs))
    assert torch.equal(learner.policy.actor.log_std, given.policy.actor.log_std)
    before, seen = learner.eval_action(obs), learner.policy.observations.shift.clone()
    learner.iterate()
    assert not torch.equal(learner.eval_action(obs), before)
    assert torch.equal(learner.policy.observations.shift, seen)  # of the state that its weights were made for


def test_learned_step_sizes_are_no_part_of_what_another_run_begins_with():
    sizing = ProMP(PointGoals(rows=16), replace(PROMP, step_sizes="layer"), seed=0)
    sizing.start_from(trained().policy_state_dict())
    sizing.iterate()
    assert float(sizing.policy.step_sizes.mean()) != 1.0
    for again in (PROMP, replace(PROMP, step_sizes="weight")):
        learner = ProMP(PointGoals(rows=16), again, seed=0)
        learner.start_from(sizing.policy_state_dict())
        assert torch.equal(learner.policy.actor.log_std, sizing.policy.actor.log_std)
        assert learner.policy.step_sizes is None or float(learner.policy.step_sizes.mean()) == 1.0


@pytest.mark.parametrize(("change", "expected"), [
    ({"hidden": (9,)}, r"hidden = \[9\], got \[8\]\. Add --learner\.hidden"),
    ({"activation": "elu"}, "activation = elu, got tanh"),
    ({"normalise_observations": False}, "normalise_observations = False, got True"),
])  # fmt: skip
def test_another_form_is_refused(change, expected):
    learner = ProMP(PointGoals(rows=16), replace(PROMP, **change), seed=0)
    with pytest.raises(BidexError, match=expected):
        learner.start_from(trained().policy_state_dict())


@pytest.mark.parametrize("preset", ["tuned", "unseen"])
@pytest.mark.parametrize("presets", [PROMP_PRESETS, MAML_PRESETS])
def test_presets_that_go_on_fit_what_mtppo_learns_on_a_laptop(presets, preset):
    tuned, given = presets[preset], PPO_PRESETS["laptop"]
    for name in ("hidden", "activation", "normalise_observations", "gamma"):
        assert getattr(tuned, name) == getattr(given, name)


@pytest.mark.parametrize("presets", [PROMP_PRESETS, MAML_PRESETS])
def test_presets_of_version_2_fit_each_other(presets):
    for name in ("hidden", "activation", "normalise_observations", "gamma"):
        assert getattr(presets["v2"], name) == getattr(PPO_PRESETS["v2"], name)


def test_a_squashed_policy_must_have_the_same_bounds_and_another_kind_is_refused():
    config = MTSACConfig(hidden=(8,), activation="tanh", normalise_observations=True, replay_steps=8)
    world = PointGoals(rows=16, autoreset_mode="SAME_STEP")
    state = MTSAC(world, config, seed=0).policy_state_dict()
    MTSAC(world, config, seed=1).start_from(state)
    with pytest.raises(BidexError, match=r"std_range = \[0.01, 3.0\], got \[0.02, 2.0\]"):
        MTSAC(world, replace(config, std_range=(0.01, 3.0)), seed=1).start_from(state)
    with pytest.raises(BidexError, match="of the same kind"):
        MTSAC(world, config, seed=0).start_from(trained().policy_state_dict())
