"""The learners by name: the only place in ``bidex_meta`` that names any.

An entry is ``"module:Class"``; a name of that form is one too, so that a learner from elsewhere needs no entry.
Beside the class the module holds ``PRESETS``: a dict from preset name to an instance of the learner's config dataclass;
``auto`` takes ``laptop`` on a CPU and ``paper`` on a GPU, or the first where one of them is missing. The class offers:

* ``Class(world, config, seed)``, and what ``bidex_meta.train.runner.Learner`` names;
* where it adapts to tasks, ``adapts = True``: then ``load_policy`` gives a MetaLearningAgent (``bidex_meta.agents``),
  which explores by a generator of its own, seeded alike by each ``load_policy``; of its config, if they are there, the
  meta-test reads ``max_adapt_steps`` (longest episode it adapts to) and ``tasks_per_class`` (of a meta-batch, over
  which a class's rows are split: as many rollouts has a task); ``adapts_by_row = True`` where rows of a task share
  nothing of what they learn;
* where it learns from data sets, ``offline = True`` and ``learn_from(data)``, which takes a ``bidex_meta.data.joined``
  before the first iteration; ``env_steps`` then counts updates, and the world is not stepped;
* where it may imitate demonstrations beside what it learns by playing, ``learn_from_demonstrations(data)``, which takes
  the same before the first iteration;
* of its config, if it is there, `run` asks ``bytes_held(rows, width)``: about what it takes beside the world;
* where it does not train in autoreset mode SAME_STEP, ``autoreset``: the mode, or a function of the learner's config
  that gives it;
* ``policy_state_dict()`` and ``load_policy(state, device)``, which gives an agent for ``bidex_meta.evaluation.play``
  from the entry ``learner.policy`` of a checkpoint.
"""

import dataclasses
import importlib
from dataclasses import dataclass
from typing import Any

from bidex_meta.errors import BidexError, known_name
from bidex_meta.outside import is_outside, outside_class
from bidex_meta.train.launch import launch

ALGOS: dict[str, str] = {
    "mtppo": "bidex_algos.onpolicy.mtppo:MTPPO",
    "mttrpo": "bidex_algos.onpolicy.mttrpo:MTTRPO",
    "mtsac": "bidex_algos.offpolicy.mtsac:MTSAC",
    "mttd3": "bidex_algos.offpolicy.td3:TD3",
    "fasttd3": "bidex_algos.offpolicy.fasttd3:FastTD3",
    "brc": "bidex_algos.offpolicy.brc:BRC",
    "promp": "bidex_algos.meta.promp:ProMP",
    "maml": "bidex_algos.meta.maml:MAML",
    "rl2": "bidex_algos.meta.rl2:RL2",
    "ippo": "bidex_algos.multiagent.ippo:IPPO",
    "mappo": "bidex_algos.multiagent.mappo:MAPPO",
    "happo": "bidex_algos.multiagent.happo:HAPPO",
    "hatrpo": "bidex_algos.multiagent.hatrpo:HATRPO",
    "maddpg": "bidex_algos.multiagent.maddpg:MADDPG",
    # On a single task they are the plain ones, with presets of their own (bidex_algos.single_task).
    "ppo": "bidex_algos.onpolicy.mtppo:MTPPO",
    "trpo": "bidex_algos.onpolicy.mttrpo:MTTRPO",
    "sac": "bidex_algos.offpolicy.mtsac:MTSAC",
    "ddpg": "bidex_algos.offpolicy.ddpg:DDPG",
    "td3": "bidex_algos.offpolicy.td3:TD3",
    # These learn from data sets (`--dataset`), of one class or of many.
    "bc": "bidex_algos.offline.bc:BC",
    "bcq": "bidex_algos.offline.bcq:BCQ",
    "td3bc": "bidex_algos.offline.td3bc:TD3BC",
    "iql": "bidex_algos.offline.iql:IQL",
}

_NEEDED = ("iterate", "state_dict", "load_state_dict", "policy_state_dict", "load_policy", "per_process")


def start_from(learner: Any, policy: dict[str, Any]) -> None:
    """Gives a fresh learner the policy of another run's checkpoint (``bidex_algos.start_from``)."""
    from bidex_algos.start_from import start_from as give

    give(learner, policy)


@dataclass(frozen=True)
class LearnerKind:
    """A learner and its presets."""

    name: str
    """Name in ``ALGOS``, or ``package.module:Class``."""
    make: Any
    """The learner's class."""
    presets: dict[str, Any]
    """Configs by name; all of one dataclass."""

    @property
    def adapts(self) -> bool:
        """Whether what it learns adapts to tasks, so that it is judged by the meta-test."""
        return getattr(self.make, "adapts", False)

    @property
    def offline(self) -> bool:
        """Whether it learns from data sets and counts updates as steps."""
        return getattr(self.make, "offline", False)

    @property
    def imitates(self) -> bool:
        """Whether it takes demonstrations beside what it learns by playing."""
        return hasattr(self.make, "learn_from_demonstrations")

    @property
    def adapts_by_row(self) -> bool:
        """Whether each row learns from its own episodes alone, so that rows of a task share nothing."""
        return getattr(self.make, "adapts_by_row", False)

    def autoreset(self, config: dict[str, Any]) -> str:
        """Mode of the world it trains on, for a config of the learner's."""
        mode: Any = getattr(self.make, "autoreset", "SAME_STEP")
        return str(mode(config) if callable(mode) else mode)


def learner_kind(name: str, task: str | None = None) -> LearnerKind:
    """Load a learner by name.

    Args:
        name: As in ``ALGOS``, in any case, or ``package.module:Class``.
        task: The task class it shall learn alone, for which it may have presets of its own.

    Raises:
        BidexError: There is none of this name, its package is not installed, or it is no learner.
    """
    if is_outside(name):
        return _from_elsewhere(name)
    name = known_name("algo", name, ALGOS)
    module_name, _, class_name = ALGOS[name].partition(":")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise BidexError(f"The algo {name!r} needs {error.name}, which is not installed.") from error
    single = importlib.import_module("bidex_algos.single_task")
    presets = single.PRESETS.get(name, module.PRESETS) | single.OF_TASK.get(name, {}).get(task, {})
    return LearnerKind(name, getattr(module, class_name), presets)


def _from_elsewhere(name: str) -> LearnerKind:
    """The learner ``package.module:Class``, of an installed package or of the working folder."""
    make, module = outside_class(name, "--algo")
    presets = getattr(module, "PRESETS", None)
    if not isinstance(presets, dict) or not presets or not all(map(dataclasses.is_dataclass, presets.values())):
        raise BidexError(
            f"--algo {name}: expected PRESETS in {module.__file__}, a dict from a preset's name to an instance of the "
            f"learner's config dataclass, found {presets!r}."
        )
    missing = [needed for needed in _NEEDED if not hasattr(make, needed)]
    if missing:
        raise BidexError(
            f"--algo {name}: expected {make.__name__} to have {', '.join(_NEEDED)}; {missing[0]} is missing."
        )
    return LearnerKind(name, make, presets)


def choose_preset(kind: LearnerKind, asked: str, device: str, first: tuple[str, str] | None = None) -> tuple[str, str]:
    """The preset's name and, in words, why this one.

    Args:
        kind: The learner.
        asked: A preset's name, or ``auto``.
        device: ``cpu``, ``cuda``, ``cuda:0``, ...
        first: A preset that goes before others where the learner has it, and why; ``Worlds.preset``.
    """
    if asked.casefold() != "auto":
        return known_name("preset", asked, ["auto", *kind.presets]), "as asked"
    if first is not None and first[0] in kind.presets:
        return first
    if not {"laptop", "paper"} <= kind.presets.keys():
        return next(iter(kind.presets)), "it is the learner's first"
    if device.startswith("cpu"):
        return "laptop", "the device is a CPU"
    if "tuned" in kind.presets:
        return "laptop", "paper is known not to be best, and tuned goes on from what another run has learned"
    return "paper", "the device is a GPU"


def resolve_device(asked: str, on_gpu: bool) -> str:
    """``auto`` to ``cuda`` where there is one, else ``cpu``; anything else as it is.

    Args:
        asked: ``auto``, ``cpu``, ``cuda``, ``cuda:0``, ...
        on_gpu: Whether a GPU is of use; ``Worlds.on_gpu``.

    Raises:
        BidexError: torch does not know the device, or it is not there (for each of several processes).
    """
    import torch

    if asked == "auto":
        asked = "cuda" if on_gpu and torch.cuda.is_available() else "cpu"
    here = launch()
    if here.count > 1 and asked.startswith("cuda:"):
        raise BidexError(f"Expected device auto, cpu or cuda, since each process takes a GPU of its own; got {asked}.")
    if here.count > 1 and asked == "cuda" and here.local_count > torch.cuda.device_count():
        raise BidexError(
            f"Expected a GPU for each of the {here.local_count} processes on this machine, found "
            f"{torch.cuda.device_count()}. Start fewer, or add --device cpu."
        )
    try:
        torch.zeros(1, device=here.own_device(asked))
    except Exception as error:  # torch raises RuntimeError, AssertionError or its own kinds
        reason = str(error).splitlines()[0]
        raise BidexError(f"Device {asked!r} cannot be used ({reason}). Expected auto, cpu or cuda:N.") from None
    return asked
