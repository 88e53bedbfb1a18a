"""Find a learner by its name, and choose its preset and device; :mod:`bidex_meta.training.learner` defines learners."""

import dataclasses
import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bidex_meta.errors import BidexError, known_name
from bidex_meta.training.launch import launch
from bidex_meta.training.learner import Capability, Learner
from bidex_meta.utils.plugins import is_outside, outside_class

ALGOS: dict[str, str] = {
    "mtppo": "bidex_algos.onpolicy.mtppo:MTPPO",
    "mttrpo": "bidex_algos.onpolicy.mttrpo:MTTRPO",
    "mtsac": "bidex_algos.offpolicy.mtsac:MTSAC",
    "mttd3": "bidex_algos.offpolicy.td3:TD3",
    "fasttd3": "bidex_algos.offpolicy.fasttd3:FastTD3",
    "brc": "bidex_algos.offpolicy.brc:BRC",
    "flashsac": "bidex_algos.offpolicy.flashsac:FlashSAC",
    "promp": "bidex_algos.meta.promp:ProMP",
    "maml": "bidex_algos.meta.maml:MAML",
    "rl2": "bidex_algos.meta.rl2:RL2",
    "varibad": "bidex_algos.meta.varibad:VariBAD",
    "pearl": "bidex_algos.meta.pearl:PEARL",
    "ippo": "bidex_algos.multiagent.ippo:IPPO",
    "mappo": "bidex_algos.multiagent.mappo:MAPPO",
    "happo": "bidex_algos.multiagent.happo:HAPPO",
    "hatrpo": "bidex_algos.multiagent.hatrpo:HATRPO",
    "maddpg": "bidex_algos.multiagent.maddpg:MADDPG",
    # These learners train on a single task.
    "ppo": "bidex_algos.onpolicy.single_task:PPO",
    "trpo": "bidex_algos.onpolicy.mttrpo:TRPO",
    "sac": "bidex_algos.offpolicy.mtsac:SAC",
    "ddpg": "bidex_algos.offpolicy.ddpg:DDPG",
    "td3": "bidex_algos.offpolicy.td3:TD3",
    # These learners imitate teachers (`--teacher`), on one class or several.
    "dagger": "bidex_algos.imitation.dagger:DAgger",
    "icl": "bidex_algos.meta.icl:ICL",
    # These learners train on data sets (`--dataset`), on one class or several.
    "bc": "bidex_algos.offline.bc:BC",
    "bcq": "bidex_algos.offline.bcq:BCQ",
    "td3bc": "bidex_algos.offline.td3bc:TD3BC",
    "iql": "bidex_algos.offline.iql:IQL",
}

USUAL_SETTINGS = (
    "learning_rate", "gamma", "hidden", "architecture", "rollout_steps", "epochs", "replay_steps", "updates_per_step",
)  # fmt: skip
"""Fields of learners' configs that are changed most often. ``bidex-meta run --help`` shows these fields if the learner
has them."""


@dataclass(frozen=True)
class LearnerKind:
    """A learner and its presets."""

    name: str  # in ALGOS, or package.module:Class
    learner_class: type[Learner]
    presets: Mapping[str, Any]  # configs by name, all of the same dataclass

    @property
    def capabilities(self) -> frozenset[Capability]:
        """Return the capabilities of the learner's class."""
        return self.learner_class.capabilities

    def autoreset(self, config: dict[str, Any]) -> str:
        """Return the autoreset mode of the world that the learner trains on.

        ``config`` maps fields of the learner's config to values; other fields have their defaults.
        """
        config_type = type(next(iter(self.presets.values())))
        return self.learner_class.autoreset_mode(config_type(**config))


def learner_class(name: str) -> type[Learner]:
    """Return the class of a learner by its name; names and errors are those of :func:`learner_kind`."""
    return learner_kind(name).learner_class


def learner_kind(name: str, task: str | None = None) -> LearnerKind:
    """Return a learner and its presets by name; raise BidexError if there is no such learner.

    ``name`` is a key of ``ALGOS`` in any case, or ``package.module:Class`` for a user's own learner. If a single task
    class ``task`` is given, presets that the learner has for this class are included.
    """
    if is_outside(name):
        found = _from_elsewhere(name)
        presets = found.presets
    else:
        name = known_name("algo", name, ALGOS)
        module_name, _, class_name = ALGOS[name].partition(":")
        try:
            module = vars(importlib.import_module(module_name))
        except ModuleNotFoundError as error:
            raise BidexError(f"The algo {name!r} needs {error.name}, which is not installed.") from error
        found = module[class_name]
        presets = found.presets or module.get("PRESETS", {})
    return LearnerKind(name, found, {**presets, **found.task_presets.get(task or "", {})})


def _from_elsewhere(name: str) -> type[Learner]:
    """Return a user's own learner by ``package.module:Class``.

    Attributes that the class does not define come from :class:`Learner`, and presets from ``PRESETS`` in its module.
    """
    make, module = outside_class(name, "--algo")
    if issubclass(make, Learner):
        bases = (make,)
    else:
        bases = (make, Learner)
    members = {"__module__": make.__module__, "__doc__": make.__doc__}
    learner: type[Learner] = type(make.__name__, bases, members)
    learner.presets = learner.presets or vars(module).get("PRESETS", {})
    presets = learner.presets
    if not isinstance(presets, dict) or not presets or not all(map(dataclasses.is_dataclass, presets.values())):
        raise BidexError(
            f"--algo {name}: expected presets in {make.__name__}, a dict from a preset's name to an instance of the "
            f"learner's config dataclass, got {presets!r}."
        )
    if missing := sorted(learner.__abstractmethods__):
        raise BidexError(
            f"--algo {name}: expected {make.__name__} to have {missing[0]}, see bidex_meta.training.learner."
        )
    return learner


def choose_preset(kind: LearnerKind, asked: str, device: str, first: tuple[str, str] | None = None) -> tuple[str, str]:
    """Choose a learner's preset; return its name and the reason for the choice as a text.

    ``asked`` is the requested preset. If it is ``auto``, the preset ``first`` is chosen if the learner has it,
    otherwise one that fits the device. ``first`` is a preset and the reason, as in ``Worlds.preset``. If a learner has
    both ``v2`` and ``gpu``, then ``gpu`` is ``v2`` for a GPU.
    """
    if asked.casefold() != "auto":
        return known_name("preset", asked, ["auto", *kind.presets]), "as asked"
    cpu = device.startswith("cpu")
    if first is not None and first[0] in kind.presets:
        name, reason = first
        if name == "v2" and "gpu" in kind.presets and not cpu:
            return "gpu", f"{reason}, and the device is a GPU"
        return first
    on_gpu = next((name for name in ("paper", "gpu") if name in kind.presets), None)
    if on_gpu is None or "laptop" not in kind.presets:
        return next(iter(kind.presets)), "it is the learner's first"
    if cpu:
        return "laptop", "the device is a CPU"
    if "tuned" in kind.presets:
        return "laptop", "paper is known not to be best, and tuned goes on from what another run has learned"
    if on_gpu == "gpu" and "v2" in kind.presets:
        return "laptop", "gpu is for version 2"
    return on_gpu, "the device is a GPU"


def resolve_device(asked: str, on_gpu: bool) -> str:
    """Return the device that a name means: ``auto`` is ``cuda`` if a GPU exists and ``on_gpu``, otherwise ``cpu``.

    ``on_gpu`` says whether the worlds profit from a GPU (``Worlds.on_gpu``). Other names are returned unchanged. Raises
    BidexError for an unknown or missing device, or if there are fewer GPUs than processes.
    """
    import torch

    from bidex_meta.engine.choice import known_device

    if asked == "auto":
        if on_gpu and torch.cuda.is_available():
            asked = "cuda"
        else:
            asked = "cpu"
    known_device(asked)
    here = launch()
    if here.count > 1 and asked.startswith("cuda:"):
        raise BidexError(f"Expected device auto, cpu or cuda, because each process takes its own GPU; got {asked}.")
    if here.count > 1 and asked == "cuda" and here.local_count > torch.cuda.device_count():
        raise BidexError(
            f"Expected a GPU for each of the {here.local_count} processes on this machine, found "
            f"{torch.cuda.device_count()}. Start fewer, or add --device cpu."
        )
    try:
        torch.zeros(1, device=here.own_device(asked))
    except Exception as error:  # torch raises RuntimeError, AssertionError or its own errors
        reason = str(error).splitlines()[0]
        raise BidexError(f"Device {asked!r} cannot be used ({reason}). Expected auto, cpu, cuda or cuda:N.") from None
    return asked
