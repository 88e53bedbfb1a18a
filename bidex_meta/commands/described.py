"""What a data set tells of itself, for whoever reads it later."""

from collections.abc import Sequence
from typing import Any

from bidex_meta.record.versions import collect_versions
from bidex_meta.worlds import Worlds


def described(source: Worlds, world: Any, kind: str, policies: Sequence[dict[str, Any]], **more: Any) -> dict[str, Any]:
    """The metadata of a data set.

    Args:
        source: Where its world came from.
        world: The world.
        kind: ``random``, ``medium``, ...
        policies: Who acted, in the order of ``Episode.policy``.
        more: What else belongs there.

    Returns:
        ``suite`` and ``suite_version``, or ``task``, ``base`` and ``object``, the others None; ``points`` of a
        cloud, as the run was told; ``tasks``, names of the
        slots; ``reward_scales``, factor on the printed reward by slot; ``hides_goals``; ``observation_groups``, [name,
        index ranges]; ``kind``, ``policies``, ``seed`` of the tasks, ``references`` ({class: {random, zero, expert}},
        unscaled returns), ``versions`` and ``commit``; all ready for JSON.
    """
    suite, alone = source.suite, source.class_name is not None
    versions = collect_versions()
    names = {name.partition("/")[0] for name in world.task_names}
    known = source.references()
    return {
        "suite": None if alone else source.name,
        "suite_version": suite.version if suite else None,
        "task": source.class_name,
        "object": source.object,
        "points": source.points,
        "base": {None: "own", True: "moving", False: "fixed"}[source.moving_base] if alone else None,
        "tasks": list(world.task_names),
        "reward_scales": {slot.name: slot.reward_scale for slot in getattr(world, "slots", ())},
        "hides_goals": source.hides_goals,
        "observation_groups": [[g.name, [[p.start, p.stop] for p in g.where]] for g in world.observation_groups],
        "kind": kind,
        "policies": list(policies),
        "seed": source.seed,
        "references": {
            name: {"random": each.random, "zero": each.zero, "expert": each.expert}
            for name, each in known.items()
            if name in names
        },
        "versions": versions,
        "commit": (versions["git"] or {}).get("commit"),
        **more,
    }
