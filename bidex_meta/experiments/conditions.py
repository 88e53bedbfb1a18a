"""Conditions of an evaluation, and checks that a run was made with this installation and suite."""

from collections.abc import Sequence

from bidex_meta.errors import BidexError, one_line
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import Conditions
from bidex_meta.runs.provenance import Difference, differences, versions_of
from bidex_meta.runs.versions import package_versions
from bidex_meta.training.launch import say
from bidex_meta.worlds import Worlds, open_worlds

_PACKAGES = ("bidex-meta", "mujoco", "torch", "numpy")


def conditions(worlds: Worlds, num_envs: int | None = None) -> Conditions:
    """Return the conditions, besides the policy, that an evaluation's numbers depend on, as in ``evaluation.json``.

    ``num_envs`` is the requested number of environments; None stands for the default.
    """
    wanted = [*_PACKAGES]
    identity: Json = worlds.identity()
    if worlds.device.startswith("cuda") or worlds.engine == "warp":
        wanted.append("mujoco-warp")
    if identity["physics"] is None:
        wanted.append("metaworld")
    installed = package_versions()
    packages = {name: installed[name] for name in wanted}
    where: Json = {"device": worlds.device, "engine": worlds.engine, "threads": worlds.threads, "num_envs": num_envs}
    return Conditions(packages=packages, **where, **identity)


def differences_of(folder: RunFolder, worlds: Worlds | None = None) -> list[Difference]:
    """Return the versions that have changed since a run was made.

    The function compares package versions, the physics, and the version and content of the run's suite. ``worlds`` is
    this suite as the installation has it now; None: the function opens it from the run's config.
    """
    return differences(versions_of(folder), conditions(worlds or open_worlds(folder.config().to_json())))


def say_differences(folder: RunFolder) -> None:
    """Log one line if a run was made with other versions than those of this installation.

    The line lists differences in packages, physics and the run's suite. Nothing is logged if the suite cannot be
    opened.
    """
    try:
        found = differences_of(folder)
    except BidexError:
        return  # the run's suite is missing here; the weights may suffice, and code that needs the suite reports it
    if found:
        say(f"{folder.path} was made with {_texts(found)}.")


def check_worlds_of(folder: RunFolder, worlds: Worlds, mend: str) -> None:
    """Raise BidexError if the suite or the physics of a run has changed since the run was made.

    Other differences, such as those in the version of torch, are only logged. ``mend`` is the advice at the end of the
    error message.
    """
    found = differences_of(folder, worlds)
    of_worlds = [difference for difference in found if difference.is_of_worlds]
    if of_worlds:
        raise BidexError(f"The worlds of {folder.path} have changed: {_texts(of_worlds)}. {mend}")
    if found:
        say(f"{folder.path} was made with {_texts(found)}.")


def _texts(found: Sequence[Difference]) -> str:
    return one_line(", ".join(map(str, found)))
