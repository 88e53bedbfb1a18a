"""A script as a policy: led from the start of each episode in a copy of the world's row, then played there."""

import torch
from torch import Tensor

from bidex_meta.witness.open_loop import Played
from bidex_meta.witness.puppets import Puppets
from bidex_meta.witness.scripts import script_of
from bidex_meta.witness.simulator import Simulator
from bidex_meta.world import World


class Scripted(Played):
    """Plays a class's script, which is led anew from the start of every episode, in a copy that knows its whole state.

    The copy has the world's physics, so that what it does there is what will happen; about a second for 500 steps.

    Args:
        world: Of one class with moving bases, on C MuJoCo; it does not reset by itself.
        noise: Standard deviation of Gaussian noise on its actions, which the script makes up for as it goes.
        seed: Of the noise.

    Raises:
        BidexError: The class has no script.
    """

    def __init__(self, world: World, noise: float = 0.0, seed: int = 0):
        (name,), rows = world.task_names, world.num_envs
        self._script, self._world = script_of(name), world
        self._copy = Simulator(name, 1, threads=1)
        super().__init__(torch.zeros(rows, self._copy.episode_steps, self._copy.action_size), torch.arange(rows))
        self._noise, self._generator = noise, torch.Generator().manual_seed(seed)

    def reset(self, env_mask: Tensor) -> None:
        """These rows stand at the start of an episode."""
        super().reset(env_mask)
        states = self._world.parts[0].group.engine.state_dict()
        for row in env_mask.nonzero().flatten().tolist():
            task = self._world.slots[0].tasks[int(self._world.task_index[row])]
            self._copy.take(task, {name: value[row].clone() for name, value in states.items()})
            hands = Puppets(self._copy, self._noise, self._generator)
            self._script(hands)
            self._keep(row, torch.stack(hands.actions))
