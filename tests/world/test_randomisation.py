"""Domain randomisation: off it changes nothing, on it changes what it says and nothing else, by counted draws."""

import copy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bidex_meta import Benchmark, BidexError, load_suite, make_task_world
from bidex_meta.engine.models import differing_fields
from bidex_meta.rules import FACTORS, Randomisation
from bidex_meta.suite_files import load_randomisation
from bidex_meta.tasks import registry
from bidex_meta.world import Slot, World, WorldConfig
from bidex_meta.worlds import open_worlds
from tests.world.play import assert_same, engine_state, flat, number_of_ends, play, random_actions
from tests.world.test_graphs import recorded  # noqa: F401  (a fixture)
from tests.world.test_masked import assert_steps_look_at_nothing, masked  # noqa: F401  (a fixture)

NOISE: dict[str, Any] = {"observation_noise": 0.02, "action_noise": 0.05, "action_delay": (0, 3)}
NOISE |= {"push_speed": 0.5, "push_interval": 0.1}
MODELS: dict[str, Any] = dict.fromkeys(FACTORS, (0.8, 1.25)) | {"object_size": (0.9, 1.1)}
ALL = Randomisation(**MODELS, **NOISE)
MT4 = (Path(load_suite("MT4").file)).read_text()
TABLE = "\n".join(f"{name} = {value}" for name, value in (MODELS | NOISE).items()).replace("(", "[").replace(")", "]")
OBJECTS = ("TwoCatchUnderarm", "DoorOpenInward", "DoorCloseInward", "BottleCap", "GraspAndPlace", "Switch")
"""Free objects, with joints and without, and fixtures; the doors share an engine."""


def one_class(rule: Randomisation | None, rows: int = 4, name: str = "CatchUnderarm", **more: Any) -> World:
    return make_task_world(name, rows, "cpu", threads=1, randomisation=rule, **more)


def classes(rule: Randomisation | None, rows: int) -> World:
    suite = load_suite("MT20")
    suite = replace(suite, classes=tuple(each for each in suite.classes if each.name in OBJECTS))
    return Benchmark(suite).make_world("train", rows, "cpu", threads=1, randomisation=rule)


def randomised_suite(folder: Path) -> str:
    file = folder / "mt4.toml"
    file.write_text(MT4.replace("[[classes]]", f"[randomisation]\n{TABLE}\n\n[[classes]]", 1))
    return str(file)


def both(*worlds: World, steps: int = 12, seed: int = 0) -> list[list[dict[str, torch.Tensor]]]:
    actions = random_actions(worlds[0], steps)
    return [[{"obs": world.reset(seed=seed)[0]}, *play(world, actions)] for world in worlds]


def test_off_is_bit_equal_and_evaluations_are_off(tmp_path: Path) -> None:
    plain = Benchmark("MT4").make_world("train", 8, "cpu", threads=1)
    suite = Benchmark(randomised_suite(tmp_path))
    off = suite.make_world("train", 8, "cpu", threads=1, randomisation=False)
    nothing = suite.make_world("train", 8, "cpu", threads=1, randomisation=Randomisation())
    a, b, c = both(plain, off, nothing, steps=40)
    assert_same(a, b)
    assert_same(a, c)
    assert plain.state_dict().keys() == nothing.state_dict().keys() and not plain.randomised and not nothing.randomised
    judged = suite.make_world("train", 8, "cpu", threads=1, autoreset_mode="DISABLED")
    assert not judged.randomised
    asked = suite.make_world("train", 8, "cpu", threads=1, autoreset_mode="DISABLED", randomisation=True)
    assert asked.randomised.keys() == suite.make_world("train", 8, "cpu", threads=1).randomised.keys()


def test_fields_of_their_own_change_nothing_by_themselves() -> None:
    plain, own = classes(None, 12), classes(None, 12)
    for part in own.parts:
        part.group.engine.expand(["geom_friction", "body_mass", "dof_M0", "geom_size", "bvh_aabb", "body_gravcomp"])
    assert any(len(part.group.members) > 1 for part in own.parts)
    assert_same(*both(plain, own, steps=30))


FIELDS = {
    "friction": {"geom_friction", "pair_friction"},
    "object_mass": {"body_mass", "body_inertia", "body_subtreemass", "body_invweight0"}
    | {"dof_invweight0", "dof_M0", "dof_armature"},
    "object_size": {"geom_size", "geom_rbound", "geom_aabb", "bvh_aabb", "geom_pos", "site_pos", "body_ipos"}
    | {"body_inertia", "body_invweight0", "dof_invweight0", "dof_M0"},
    "actuator_gain": {"actuator_gainprm", "actuator_biasprm"},
    "joint_damping": {"dof_damping"},
    "gravity": {"body_gravcomp"},
}
LOOSE = {"dof_length", "light_poscom0"}
"""What MuJoCo derives for sleep and pictures."""


@pytest.mark.parametrize("factor", FACTORS)
def test_a_factor_changes_its_fields_and_all_that_follows(factor: str) -> None:
    varied: dict[str, Any] = {factor: MODELS[factor]}
    world = classes(Randomisation(**varied), 6)
    world.reset(seed=0)
    changed = set()
    for part in world.parts:
        for member in part.group.members:
            model = part.group.engine.batch.get_model(member.engine_rows.start)  # type: ignore[attr-defined]
            changed |= set(differing_fields(member.scene.model, model)) & FIELDS[factor]
            assert set(differing_fields(member.scene.model, model)) <= FIELDS[factor]
            anew = copy.copy(model)
            mujoco.mj_setConst(anew, mujoco.MjData(anew))
            for name in set(differing_fields(model, anew)) - LOOSE:
                ours, theirs = (
                    np.asarray(getattr(each, name))[int(name == "body_subtreemass") :] for each in (model, anew)
                )
                assert np.allclose(ours, theirs, rtol=1e-10, atol=1e-12), (world.task_names[member.slot], name)
    assert changed == FIELDS[factor]


@given(st.floats(0.9, 1.0), st.floats(1.0, 1.1), st.integers(0, 3), st.integers(0, 10**6))
@settings(max_examples=25)
def test_draws_are_within_bounds_and_counted(low: float, high: float, most: int, number: int) -> None:
    world = _WORLD[0] if _WORLD else _WORLD.append(one_class(ALL, 16)) or _WORLD[0]
    least = min(1, most)
    rule = Randomisation(**dict.fromkeys(FACTORS, (low, high)), action_delay=(least, most))
    randomiser = world._randomiser
    assert randomiser is not None
    randomiser._rule, everyone = rule, torch.ones(16, dtype=torch.bool)
    drawn = []
    for episode in (number, number + 1, number):
        randomiser.begin(everyone, torch.full((16,), episode))
        drawn.append(world.randomised)
        for name, values in drawn[-1].items():
            ends = (least, most) if name == "action_delay" else (low, high)
            assert bool(((values >= ends[0]) & (values <= ends[1])).all()), name
    assert all(torch.equal(drawn[0][name], drawn[2][name]) for name in drawn[0])
    if high - low > 0.01:
        assert all(not torch.equal(drawn[0][name], drawn[1][name]) for name in FACTORS)


_WORLD: list[World] = []


def test_per_episode_or_per_environment() -> None:
    for draw in ("episode", "environment"):
        world = one_class(Randomisation(**MODELS, **NOISE, draw=draw), autoreset_mode="DISABLED")
        world.reset(seed=0)
        first = world.randomised
        world.reset(options={"reset_mask": torch.tensor([False, True, False, False])})
        for name, before in first.items():
            same = world.randomised[name] == before
            assert bool(same[[0, 2, 3]].all()) and (draw == "episode" or bool(same[1]))
            assert draw == "environment" or name == "action_delay" or not bool(same[1])
        world.reset(seed=1)
        assert not torch.equal(world.randomised["friction"], first["friction"])


def test_single_environments_keep_what_is_drawn_once_until_they_are_seeded() -> None:
    for draw, kinds in (("episode", 3), ("environment", 1)):
        suite = replace(load_suite("MT1"), randomisation=Randomisation(friction=(0.5, 1.5), draw=draw))
        benchmark = Benchmark(suite)
        env = benchmark.train_classes["CatchUnderarm"]()
        env.set_task(benchmark.train_tasks[0])
        found = []
        for seed in (0, None, None, 0, 1):
            env.reset(seed=seed)
            found.append(float(env._world.randomised["friction"][0]))
        assert len({*found[:3]}) == kinds and found[3] == found[0] and found[4] != found[0]


def test_a_mixture_of_moving_and_fixed_hands_is_refused() -> None:
    found = {"a": registry.get("HandOver", False), "b": registry.get("CatchUnderarm", True)}
    slots = [Slot(name, task, task.variation_space.sample(np.random.default_rng(0), 1)) for name, task in found.items()]
    with pytest.raises(BidexError, match=r"one number of actions, got \{'a': 40, 'b': 52\}"):
        World(slots, WorldConfig(num_envs=2, threads=1))


def test_neither_threads_nor_rows_nor_the_way_of_resets_change_a_draw(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    suite = Benchmark(randomised_suite(tmp_path))
    worlds = [suite.make_world("train", 8, "cpu", threads=threads) for threads in (1, 2)]
    request.getfixturevalue("masked")
    worlds.append(suite.make_world("train", 8, "cpu"))
    a, b, c = both(*worlds, steps=40)
    assert number_of_ends(a[1:]) > 4
    assert_same(a, b)
    assert_same(a, c)
    assert_steps_look_at_nothing(worlds[2], pytest.MonkeyPatch())


def test_replayed_graphs_are_plain_steps(tmp_path: Path, recorded: Callable[..., Any]) -> None:  # noqa: F811
    file = randomised_suite(tmp_path)
    assert_same(*both(Benchmark(file).make_world("train", 8, "cpu", threads=1), recorded(file, 8)[0], steps=30))


def test_a_saved_state_and_a_copy_continue_bit_for_bit() -> None:
    used = one_class(ALL, 6)
    used.reset(seed=5)
    actions = random_actions(used, 60)
    play(used, actions[:30])
    fresh, twin = one_class(ALL, 6), copy.deepcopy(used)
    fresh.load_state_dict(used.state_dict())
    a, b, c = (play(world, actions[30:]) for world in (used, fresh, twin))
    assert number_of_ends(a) > 0
    assert_same(a, b)
    assert_same(a, c)


def test_a_delay_is_of_whole_steps() -> None:
    plain, late = one_class(None), one_class(Randomisation(action_delay=(2, 2)))
    for world in (plain, late):
        world.reset(seed=0)
    actions = random_actions(plain, 10)
    a = play(plain, torch.cat((torch.zeros_like(actions[:2]), actions)))
    b = play(late, torch.cat((actions, torch.zeros_like(actions[:2]))))
    assert all(torch.equal(x["reward"], y["reward"]) for x, y in zip(a, b, strict=True))
    ours, theirs = (engine_state(world)[0]["qpos"] for world in (plain, late))
    assert torch.equal(ours, theirs)


def columns(world: World, what: Callable[[Any], bool]) -> list[int]:
    layout = world.slots[0].task_class.layout
    return [i for block, where in layout if what(block) for i in range(where.start, where.stop)]


def test_noise_is_on_what_is_sensed_alone() -> None:
    plain, noisy = (one_class(Randomisation(observation_noise=s), 32) for s in (0.0, 0.1))
    a, b = both(plain, noisy, steps=8)
    assert all(torch.equal(x["reward"], y["reward"]) for x, y in zip(a[1:], b[1:], strict=True))
    difference = torch.stack([y["obs"] - x["obs"] for x, y in zip(a, b, strict=True)])
    unseen = {"right_action", "left_action", "goal_pose"}  # the rotation from object to goal is seen
    clear = columns(plain, lambda block: block.name in unseen)
    assert not difference[..., clear].any()
    sensed = torch.tensor([i for i in range(plain.observation_size) if i not in clear])
    seen = difference[..., sensed][torch.stack([x["obs"] for x in a])[..., sensed].abs() < 4.0]
    assert abs(float(seen.std()) - 0.1) < 0.002 and abs(float(seen.mean())) < 0.002
    assert not torch.equal(difference[1], difference[2]) and not torch.equal(difference[0, 0], difference[0, 1])


def test_noise_leaves_masked_goals_padding_and_ids() -> None:
    rule = Randomisation(observation_noise=0.5)
    for name in ("ML4", "MT4"):
        plain, noisy = (Benchmark(name).make_world(num_envs=8, device="cpu", randomisation=r) for r in (None, rule))
        a, b = both(plain, noisy, steps=2)
        clear = ("goal", "padding", "task_id") if name == "ML4" else ("padding", "task_id")
        for group in plain.observation_groups:
            if group.name in clear:
                for where in group.where:
                    assert all(torch.equal(x["obs"][:, where], y["obs"][:, where]) for x, y in zip(a, b, strict=True))


def test_noise_on_actions_is_not_shown() -> None:
    world = one_class(Randomisation(action_noise=0.1))
    world.reset(seed=0)
    action = random_actions(world, 1)[0]
    obs = world.step(action)[0]
    shown = obs[:, columns(world, lambda block: block.name == "right_action")]
    assert torch.equal(shown, action[:, : shown.shape[1]])
    targets = world.parts[0].group.engine.ctrl.clone()
    world = one_class(None)
    world.reset(seed=0)
    world.step(action)
    difference = targets - world.parts[0].group.engine.ctrl
    assert bool((difference != 0).any(dim=1).all()) and float(difference.abs().max()) < 0.6


def test_pushes_accelerate_all_objects_alike_and_nothing_else() -> None:
    world = classes(Randomisation(push_speed=0.5, push_interval=0.1, object_mass=(0.5, 2.0)), 60)
    world.reset(seed=0)
    pushed = 0
    for action in random_actions(world, 10):
        world.step(0.0 * action)
        for part in world.parts:
            engine = part.group.engine
            for member in part.group.members:
                names = [member.scene.model.body(i).name for i in range(member.scene.model.nbody)]
                mine = torch.tensor([not name.startswith(("right/", "left/", "world")) for name in names])
                force = engine.xfrc_applied[member.engine_rows, :, :3]
                masses = engine.batch.expanded("body_mass")[member.engine_rows]  # type: ignore[attr-defined]
                change = force[:, mine] / torch.from_numpy(masses.copy())[:, mine, None] / 60.0
                assert not force[:, ~mine].any() and float(change.abs().max()) <= 0.5
                assert torch.allclose(change, change[:, :1], rtol=1e-9)
                pushed += int(change.any(dim=2).any(dim=1).sum())
    assert 60 < pushed < 140  # of 600 steps a sixth


def test_larger_objects_start_above_what_they_lie_on() -> None:
    rule = Randomisation(object_size=(1.1, 1.1))
    for name in ("PushBlock", "CatchUnderarm"):
        depths = []
        for chosen in (None, rule):
            world = one_class(chosen, 8, name)
            world.reset(seed=0)
            engine = world.parts[0].group.engine
            depths.append(max(float(max(0.0, -engine.data(i).contact.dist.min(initial=0.0))) for i in range(8)))
        assert depths[1] < depths[0] + 2e-3


def test_both_engines_draw_and_apply_the_same() -> None:
    c, warp = (one_class(ALL, 2, engine=engine, stagger=False) for engine in ("c", "warp"))
    assert torch.allclose(c.reset(seed=0)[0], warp.reset(seed=0)[0], atol=1e-5)
    assert all(torch.equal(c.randomised[name], warp.randomised[name]) for name in c.randomised)
    for action in random_actions(c, 4):
        for world in (c, warp):
            world.step(action)
    ours, theirs = (world.parts[0].group.engine for world in (c, warp))
    assert torch.allclose(ours.qpos.float(), theirs.qpos, atol=2e-3)
    assert torch.allclose(ours.xfrc_applied.float(), theirs.xfrc_applied, rtol=1e-5, atol=1e-4)


def test_bad_input(tmp_path: Path) -> None:
    with pytest.raises(BidexError, match=r"randomisation: gravity: expected two rising numbers, got 1\.2 0\.8"):
        Randomisation(gravity=(1.2, 0.8))
    with pytest.raises(BidexError, match="randomisation: expected a Randomisation, got 3"):
        one_class(3)  # type: ignore[arg-type]
    size = Randomisation(object_size=(0.9, 1.1))
    for more in ({"object": "mug"}, {"pixels": 32}, {"points": 128}):
        with pytest.raises(BidexError, match=r"object_size: expected (neither points nor pixels|the egg, got Catch)"):
            one_class(size, 2, **more)
    file = tmp_path / "table.toml"
    file.write_text("friction = [0.7, 1.3]\n")
    with pytest.raises(BidexError, match=r"table\.toml: expected a table \[randomisation\], found none"):
        load_randomisation(file)
    file.write_text("[randomisation]\nfriction = [0.7, 1.3]\n")
    assert load_randomisation(file) == Randomisation(friction=(0.7, 1.3))
    for named in ({"suite": "MT4"}, {"task": "HandOver"}):
        world = open_worlds({**named, "randomisation": str(file)}).world(rows=4 if "suite" in named else 2)
        assert list(world.randomised) == ["friction"]  # type: ignore[attr-defined]
    with pytest.raises(BidexError, match="Only bidex-meta's own worlds can be randomised, got metaworld/MT3"):
        open_worlds({"suite": "metaworld/MT3", "randomisation": str(file)})
    suite = randomised_suite(tmp_path)
    worlds = open_worlds({"suite": suite})
    assert not worlds.world(rows=4).randomised  # type: ignore[attr-defined]
    assert worlds.world("train", 4, "DISABLED").randomised  # type: ignore[attr-defined]  (to train so)
    assert flat(worlds.world(rows=4).reset(seed=0))  # it runs
