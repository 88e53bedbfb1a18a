"""Under what an evaluation was made: what else than the policy its numbers depend on."""

from typing import Any

from bidex_meta.config import RunConfig
from bidex_meta.record.versions import package_versions
from bidex_meta.worlds import Worlds

_PACKAGES = ("bidex-meta", "mujoco", "torch", "numpy")


def conditions(source: Worlds, num_envs: int | None = None) -> dict[str, Any]:
    """Ready for JSON, as ``evaluation.json`` keeps it under ``conditions``.

    Args:
        source: Of the worlds that were played.
        num_envs: Rows that were asked for; None: the default.
    """
    wanted, identity = [*_PACKAGES], source.identity()
    if source.device.startswith("cuda") or source.engine == "warp":
        wanted.append("mujoco-warp")
    if identity["physics"] is None:
        wanted.append("metaworld")
    installed = package_versions()
    packages = {name: installed[name] for name in wanted}
    where = {"device": source.device, "engine": source.engine, "threads": source.threads, "num_envs": num_envs}
    return {**where, "packages": packages, **identity}


def recorded_conditions(evaluation: dict[str, Any], versions: dict[str, Any], config: RunConfig[Any]) -> dict[str, Any]:
    """The same of an evaluation as it was recorded; of an older one what its run was trained with.

    Args:
        evaluation: Of ``evaluation.json``.
        versions: Of ``versions.json``, empty where there is none.
        config: The run's.
    """
    found = {"device": config.device, "engine": config.engine, "num_envs": None}
    found |= {name: versions.get(name) for name in ("packages", "physics", "suite_version")}
    found |= evaluation.get("conditions", {})
    packages = found["packages"]
    return found | {"packages": packages if isinstance(packages, dict) else {}}


def others(then: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """What is not now as it was then, a text each, in words; of what nobody recorded it says so once."""
    packages = then["packages"]
    pairs = [(name, packages.get(name), version) for name, version in now["packages"].items()]
    pairs += [(name, then.get(name), now[name]) for name in ("device", "engine", "threads")]
    pairs += [(name.replace("_", " "), then.get(name), now[name]) for name in ("physics", "suite_version")]
    told = [f"{name} {old} then, {new} now" for name, old, new in pairs if None not in (old, new) and old != new]
    unknown = [name for name, old, new in pairs if old is None and new is not None and name != "threads"]
    return told + ([f"not recorded: {', '.join(unknown)}"] if unknown else [])
