"""The learners' configs: what out of bounds is refused by the field's name, and that hostile values are too."""

from typing import Any

import pytest

from bidex_meta.errors import BidexError
from bidex_meta.experiments.learners import ALGOS, learner_kind

WRONG: dict[str, dict[str, Any]] = {
    "mtppo": {
        "epochs": 0, "gamma": 1.5, "std_range": (1.0, 0.5), "clip": -0.2, "demonstration_batch": 0,
        "demonstration_cloning": -1, "critic_first": -1, "point_widths": (8, 0), "teacher_updates": -1,
        "learning_rate_range": (1.0, 0.5),
    },
    "mttrpo": {"max_kl": 0.0, "backtrack_factor": 1.5, "fisher_stride": 0, "cg_iterations": 0, "damping": -1.0},
    "mtsac": {
        "updates_per_step": 0, "batch_per_task": 0, "warmup_steps": -1, "gamma": 1.0, "tau": 0.0, "cut_share": 2.0,
        "replay_memory": 0.0, "task_embedding": -1, "init_alpha": 0.0,
        "std_range": (1.0, 0.5), "init_std": 3.0, "point_widths": (),
    },
    "ddpg": {"tau": 0.0, "exploration_std": (0.5, 0.1), "squash_price": -1.0},
    "td3": {"target_std": -0.1, "target_bound": float("nan"), "policy_delay": 0, "exploration_std": (-0.1, 0.1)},
    "fasttd3": {"atoms": 1, "value_bound": 0.0, "n_steps": 0, "weight_decay": -0.1},
    "brc": {"critic_hidden": (8, 16), "hidden": (), "atoms": 1},
    "flashsac": {"critic_hidden": (8, 16), "hidden": (), "noise_repeats": 0, "policy_delay": 0},
    "promp": {"inner_steps": 0, "gamma": 2.0, "init_std": 0.0, "std_range": (1.0, 0.5), "outer_epochs": 0},
    "maml": {"backtracks": 0, "slice_steps": 0},
    "rl2": {"chunk": 0, "gamma": 1.5, "blind_share": -0.1, "reward_unit": 0.0, "hidden": ()},
    "varibad": {"latent": 0, "kl_weight": -0.1, "belief_learning_rate": 0.0},
    "pearl": {"latent": 0, "encoder": (), "context": 0, "kl_weight": -0.1, "episodes_per_trial": 1, "reward_unit": 0.0},
    "mappo": {"huber_delta": 0.0, "value_clip": -1.0},
    "hatrpo": {"max_factor": 0.5},
    "iql": {"expectile": 1.0, "beta": -1.0, "std_range": (2.0, 1.0)},
    "bcq": {"perturbation": 2.5, "lower_weight": -0.1, "latent": 0},
    "td3bc": {"alpha": -1.0, "policy_delay": 0},
    "dagger": {"teacher_steps": -1, "noise_std": -0.1, "samples": 0, "updates_per_iteration": 0, "max_grad_norm": 0.0},
    "icl": {"reward_unit": 0.0, "candidates": 0, "batch_size": 0, "trials": 0, "head": (0,)},
}  # fmt: skip
TOGETHER: list[tuple[str, dict[str, Any], str]] = [
    ("mtsac", {"architecture": "paco", "task_embedding": 4}, "task_embedding goes with architecture shared"),
    ("mtppo", {"architecture": "soft_modules", "hidden": (32,)}, "at least two widths"),
    ("mtppo", {"architecture": "moore", "hidden": (32, 3)}, "the last width of hidden must be at least 4"),
    ("mtppo", {"architecture": "moore", "hidden": ()}, "the last width of hidden must be at least 4"),
    ("dagger", {"architecture": "transformer", "hidden": (32, 16)}, "one width for all of hidden"),
    ("mtppo", {"architecture": "transformer", "hidden": (33, 33)}, "a multiple of its 4 attention heads"),
    ("mtppo", {"architecture": "transformer", "hidden": ()}, "one width for all of hidden"),
    ("fasttd3", {"architecture": "soft_modules", "critic_hidden": (64,)}, "two widths in critic_hidden"),
    ("ippo", {"popart": True, "share_parameters": True}, "popart needs a critic for each agent"),
    ("mappo", {"popart": True, "value_heads": False}, "leave value_heads on"),
    ("happo", {"agents": "thumbs"}, "agents: expected single"),
    ("iql", {"init_std": 10.0}, r"iql: init_std: expected a number within std_range, 0.0067 to 7.4, got 10.0"),
    ("brc", {"critic_layer_norm": False}, "leave critic_layer_norm out"),
    ("flashsac", {"critic_layer_norm": False}, "leave critic_layer_norm out"),
]
HOSTILE: tuple[Any, ...] = ("1e3", None, True, [1], {}, float("inf"))


@pytest.mark.parametrize(("algo", "field"), [(algo, field) for algo, wrong in WRONG.items() for field in wrong])
def test_a_value_out_of_bounds_is_refused_by_its_field(algo: str, field: str) -> None:
    config = type(learner_kind(algo).presets["laptop"])
    with pytest.raises(BidexError, match=f"{algo}: .*{field}"):
        config(**{field: WRONG[algo][field]})


@pytest.mark.parametrize(("algo", "options", "told"), TOGETHER)
def test_what_does_not_go_together_is_refused(algo: str, options: dict[str, Any], told: str) -> None:
    with pytest.raises(BidexError, match=told):
        type(learner_kind(algo).presets["laptop"])(**options)


@pytest.mark.parametrize("algo", ALGOS)
def test_values_of_another_type_are_refused(algo: str) -> None:
    config = type(learner_kind(algo).presets["laptop"])
    rate = "inner_learning_rate" if "inner_learning_rate" in vars(config()) else "learning_rate"
    rate = "critic_learning_rate" if algo in ("mttrpo", "trpo", "hatrpo") else rate
    for value in HOSTILE:
        if value is not None:
            with pytest.raises(BidexError, match=f": {rate}: "):
                config(**{rate: value})
        with pytest.raises(BidexError, match=r": hidden\S*: "):
            config(hidden=(value,))
