"""Worlds in pickles and copies: as what they were made with and their state, since engines cannot be copied."""

from typing import Any, Self


class Recreated:
    """Makes a world that can be pickled and copied: the copy is built anew and goes on bit for bit.

    Its class has ``state_dict`` and ``load_state_dict``, and tells by ``_ready`` whether it may be stepped. Engine
    threads that were left out are counted anew where the copy is made; attributes set from outside stay
    behind, ``stagger`` alone does not.
    """

    _made_with: tuple[tuple[Any, ...], dict[str, Any]]
    _ready: bool
    stagger: bool

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Keeps what the constructor is given."""
        made = super().__new__(cls)
        made._made_with = args, kwargs
        return made

    def __reduce__(self) -> tuple[Any, ...]:
        world: Any = self
        return _recreate, (type(self), *self._made_with, world.state_dict(), self._ready, self.stagger)


def _recreate(
    kind: type, args: tuple[Any, ...], kwargs: dict[str, Any], state: dict[str, Any], ready: bool, stagger: bool
) -> Any:
    world = kind(*args, **kwargs)
    world.load_state_dict(state)
    world._ready, world.stagger = ready, stagger
    return world
