"""The state that a task class reads: sensor values, and the values that the environments' tasks fix."""

from collections.abc import Callable, Iterable

from torch import Tensor

from bidex_meta.errors import BidexError, unknown_name
from bidex_meta.utils.maths import xyzw


def unknown_sensor(name: str, known: Iterable[str]) -> BidexError:
    """Return an error for a sensor that does not exist; the message lists the sensors of the same object, if any."""
    names = list(known)
    return unknown_name("sensor", name, [each for each in names if each.split("/")[0] == name.split("/")[0]] or names)


class TaskState:
    """The state of a class's environments after a step.

    Args:
        sensors: Sensor values, shape (n, nsensordata), in the engine's precision; not copied.
        addresses: Slice of each sensor, by the sensor's name.
        frozen: Values that ``TaskClass.freeze`` computed from the environments' variations, each (n, k).
    """

    def __init__(self, sensors: Tensor, addresses: dict[str, slice], frozen: dict[str, Tensor]) -> None:
        self._sensors = sensors
        self._addresses = addresses
        self._known = {}
        self.frozen = frozen

    def __getitem__(self, name: str) -> Tensor:
        """Return the values of the named sensor, shape (n, k); raise BidexError for an unknown sensor."""
        try:
            return self._sensors[:, self._addresses[name]]
        except KeyError:
            raise unknown_sensor(name, self._addresses) from None

    def quaternion(self, name: str) -> Tensor:
        """Return the orientation (x, y, z, w) read from the named framequat sensor, shape (n, 4)."""
        return self.once(("quaternion", name), lambda: xyzw(self[name]))

    def once(self, key: object, compute: Callable[[], Tensor]) -> Tensor:
        """Return the result of ``compute``, which is called only for the first request of each ``key``.

        This lets reward, success and observation share values of the same state.
        """
        if key not in self._known:
            self._known[key] = compute()
        return self._known[key]
