import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.distributions import Independent, Normal, kl_divergence
from torch.func import grad
from torch.testing import assert_close

from bidex_algos.nets import products
from bidex_algos.nets.architecture import follow
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import GaussianActor, gaussian_entropy, gaussian_kl, gaussian_log_prob, use_bfloat16
from bidex_algos.nets.normalise import RunningStats, TaskNormaliser
from bidex_algos.nets.point_net import PointNet
from bidex_algos.nets.policy import SquashedActor, sample_squashed
from bidex_algos.nets.products import affine
from bidex_meta.utils import maths
from bidex_meta.world.contract import plain_groups

TASKS_LAST = Inputs(plain_groups(5, 2))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 6))
def test_gaussian_formulas_agree_with_torch_distributions(seed: int, actions: int):
    g = torch.Generator().manual_seed(seed)
    action, mean_p, mean_q = torch.randn(3, 5, actions, generator=g, dtype=torch.float64)
    log_p, log_q = torch.randn(2, actions, generator=g, dtype=torch.float64)
    p, q = (Independent(Normal(m, s.exp()), 1) for m, s in ((mean_p, log_p), (mean_q, log_q)))
    assert_close(gaussian_log_prob(action, mean_p, log_p), p.log_prob(action))
    assert_close(gaussian_kl(mean_p, log_p, mean_q, log_q), kl_divergence(p, q))
    assert_close(gaussian_entropy(log_p).expand(5), p.entropy())


def test_initial_weights_follow_the_seed_and_leave_the_global_generator_alone():
    before = torch.random.get_rng_state()
    nets = [GaussianActor(7, (16, 8), 3, 0.8, torch.Generator().manual_seed(s)) for s in (0, 0, 1)]
    assert torch.equal(torch.random.get_rng_state(), before)
    assert torch.equal(nets[0].mean.head.weight, nets[1].mean.head.weight)
    assert not torch.equal(nets[0].mean.head.weight, nets[2].mean.head.weight)
    weight = nets[0].mean.head.weight
    assert_close(weight @ weight.T, 1e-4 * torch.eye(3), atol=1e-8, rtol=1e-4)
    assert_close(nets[0].log_std.exp(), torch.full((3,), 0.8))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.lists(st.integers(1, 9), min_size=1, max_size=5))
def test_running_stats_equal_those_of_the_whole_stream(seed: int, sizes: list[int]):
    x = 100.0 + torch.randn(sum(sizes), 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    stats = RunningStats((3,))
    for part in x.split(sizes):
        stats.merge(part.mean(0), part.var(0, correction=0), len(part))
    assert_close(stats.mean, x.mean(0))
    assert_close(stats.var, x.var(0, correction=0))


def test_running_stats_skip_empty_groups_and_forget_beyond_max_count():
    stats = RunningStats((2,), max_count=10)
    for _ in range(50):
        stats.merge(torch.tensor([5.0, 9.0]), torch.tensor([0.0, 4.0]), torch.tensor([0.0, 10.0]))
    assert stats.mean.tolist() == [0.0, 9.0] and stats.var.tolist() == [1.0, 4.0]
    for _ in range(20):
        stats.merge(torch.tensor([5.0, -9.0]), torch.tensor([1.0, 1.0]), torch.tensor([1.0, 10.0]))
    assert_close(stats.mean[1], torch.tensor(-9.0, dtype=torch.float64), atol=1e-3, rtol=0)


def test_each_task_is_normalised_by_its_own_statistics():
    inputs = Inputs(plain_groups(5, 3))
    one_hot = torch.eye(3)[[0] * 200 + [2] * 100]  # of the second nothing is seen
    obs = torch.cat([torch.randn(300, 2) * torch.tensor([0.1, 50.0]), one_hot], dim=1)
    obs[200:, :2] = obs[200:, :2] * 30 - 4
    normaliser, halves = TaskNormaliser(inputs, 3), TaskNormaliser(inputs, 3)
    normaliser.update(obs)
    for half in (obs[:250], obs[250:]):
        halves.update(half.view(-1, 10, 5))
    out = normaliser(obs.view(-1, 10, 5)).view(300, 5)
    for of_task in (out[:200], out[200:]):
        assert_close(of_task[:, :2].mean(0), torch.zeros(2), atol=1e-4, rtol=0)
        assert_close(of_task[:, :2].std(0, correction=0), torch.ones(2), atol=2e-3, rtol=0)
    assert torch.equal(out[:, 2:], one_hot)
    assert_close(halves(obs), normaliser(obs))
    unseen = torch.tensor([[3.0, -2.0, 0.0, 1.0, 0.0]])
    assert_close(normaliser(unseen), unseen)
    normaliser.keep()
    normaliser.update(unseen + torch.tensor([0.0, 5.0, 0.0, 0.0, 0.0]))
    assert_close(normaliser.shift[1, :2], torch.tensor([3.0, 3.0]))  # what was not seen is learned still


@pytest.mark.parametrize("tells", [(), ("_is_amx_tile_supported",), ("_is_avx512_bf16_supported",)])
def test_auto_takes_bfloat16_where_the_processor_multiplies_it(tells: tuple[str, ...], monkeypatch: pytest.MonkeyPatch):
    for name in ("_is_amx_tile_supported", "_is_avx512_bf16_supported"):
        monkeypatch.setattr(torch.cpu, name, lambda told=name in tells: told, raising=False)
    cpu = torch.device("cpu")
    assert use_bfloat16("auto", cpu) == bool(tells)
    assert use_bfloat16("on", cpu) and not use_bfloat16("off", cpu)


ROWS, INPUTS, OUTPUTS = 8, 6, 5


@pytest.fixture(params=[False, True], ids=["own", "onednn"])
def chosen(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param:
        try:
            products._onednn(torch.ones(2, 3), torch.ones(2, 3), None)
        except (AttributeError, RuntimeError):
            pytest.skip("PyTorch without oneDNN's product")
    monkeypatch.setattr(products, "_LEAST", 1)
    monkeypatch.setattr(products, "is_faster_here", lambda: request.param)


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).requires_grad_()


@pytest.mark.parametrize("shape", [(ROWS, INPUTS), (2, ROWS // 2, INPUTS), (INPUTS,)])
@pytest.mark.parametrize("biased", [True, False])
def test_values_and_gradients_are_those_of_double_precision(chosen, shape, biased) -> None:
    x, weight = drawn(*shape), drawn(OUTPUTS, INPUTS, seed=1)
    bias = drawn(OUTPUTS, seed=2) if biased else None
    leaves = [x, weight] + [bias] * biased
    out = affine(x, weight, bias)
    doubles = [leaf.detach().double().requires_grad_() for leaf in leaves]
    expected = torch.nn.functional.linear(*doubles)
    assert_close(out.double(), expected, rtol=1e-5, atol=1e-5)
    found = torch.autograd.grad(out.square().sum(), leaves)
    for one, other in zip(found, torch.autograd.grad(expected.square().sum(), doubles), strict=True):
        assert_close(one.double(), other, rtol=1e-5, atol=1e-4)
    with torch.no_grad():
        assert torch.equal(affine(x, weight, bias), out)


def test_gradients_have_gradients(chosen) -> None:
    x, first, second = drawn(ROWS, INPUTS), drawn(INPUTS, INPUTS, seed=1), drawn(OUTPUTS, INPUTS, seed=2)

    def stepped(product, x, first, second):
        def loss(weight):
            return product(torch.tanh(product(x, weight)), second).square().sum()

        return loss(first - 0.1 * grad(loss)(first))

    found = torch.autograd.grad(stepped(affine, x, first, second), (first, second))
    doubles = [t.detach().double().requires_grad_() for t in (x, first, second)]
    expected = torch.autograd.grad(stepped(torch.nn.functional.linear, *doubles), doubles[1:])
    for one, other in zip(found, expected, strict=True):
        assert_close(one.double(), other, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("processor", "faster"), [("AuthenticAMD", True), ("GenuineIntel", False)])
def test_onednn_is_chosen_on_amds_processors_alone(monkeypatch, processor, faster) -> None:
    monkeypatch.setattr(products, "_processor", lambda: processor)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    monkeypatch.setattr(products, "_onednn", torch.nn.functional.linear)
    assert products.is_faster_here.__wrapped__() is faster


def actor(heads: int = 1, init_std: float = 0.5, std_range: tuple[float, float] = (0.02, 2.0)) -> SquashedActor:
    inputs, g = Inputs(plain_groups(5, 2)), torch.Generator().manual_seed(0)
    return SquashedActor(inputs, (16,), 3, heads, init_std, std_range, g, "relu")


def test_value_and_gradient_stay_finite_where_tanh_rounds_to_one():
    mean = torch.tensor([[50.0, -50.0, 0.0]], requires_grad=True)
    log_std = torch.zeros(1, 3, requires_grad=True)
    action, log_prob = sample_squashed(mean, log_std, torch.ones(1, 3))
    assert action[0, 0] == 1.0
    # For large u, the slope of tanh is 4 exp(-2|u|).
    expected = -1.5 - 1.5 * math.log(2 * math.pi) + (2 * 51 - math.log(4)) + (2 * 49 - math.log(4)) + 0.8675617
    assert_close(log_prob, torch.tensor([expected]), rtol=1e-5, atol=1e-4)
    (log_prob + action.sum()).sum().backward()
    assert mean.grad is not None and log_std.grad is not None
    assert mean.grad.isfinite().all() and log_std.grad.isfinite().all()


def test_the_actor_starts_at_zero_with_its_standard_deviation_and_keeps_the_bounds():
    mean, log_std = actor()(torch.randn(100, 5, generator=torch.Generator().manual_seed(0)))
    assert mean.abs().max() < 0.1
    assert_close(log_std.exp(), torch.full((100, 3), 0.5), rtol=0.1, atol=0)
    wild = actor()
    with torch.no_grad():
        wild.net.head.weight.mul_(1e6)
    std = wild(torch.randn(100, 5))[1].exp()
    assert 0.0199 < std.min() < 0.021 and 1.9 < std.max() < 2.001


def net(points: int, channels: int = 3) -> PointNet:
    generator = torch.Generator().manual_seed(0)
    return PointNet(points * channels, generator, (8, 16), channels)


def clouds(points: int, channels: int = 3) -> Tensor:
    return torch.randn(5, points, channels, generator=torch.Generator().manual_seed(1)) * 0.1


def test_order_and_repetition_of_points_do_not_matter_but_for_the_centre() -> None:
    made, cloud = net(40), clouds(40)
    shuffled = cloud[:, torch.randperm(40, generator=torch.Generator().manual_seed(2))]
    assert_close(made(cloud.flatten(1)), made(shuffled.flatten(1)))
    twice = torch.cat((cloud, cloud), dim=1)
    assert_close(made(cloud.flatten(1)), net(80)(twice.flatten(1)))
    away = cloud + torch.tensor([1.0, -2.0, 0.5])
    before, after = made(cloud.flatten(1)), made(away.flatten(1))
    assert_close(after[:, :-3], before[:, :-3], atol=1e-4, rtol=1e-4)
    assert_close(after[:, -3:] - before[:, -3:], torch.tensor([[1.0, -2.0, 0.5]]).expand(5, 3))


@pytest.mark.parametrize("channels", [3, 4])
def test_the_gradient_through_the_largest_points_is_that_through_all(channels: int) -> None:
    made, cloud = net(40, channels), clouds(40, channels)
    made(cloud.flatten(1)).square().sum().backward()
    short = [weights.grad.clone() for weights in made.parameters() if weights.grad is not None]
    made.zero_grad()
    centre = cloud[..., :3].mean(dim=1, keepdim=True)
    points = torch.cat(((cloud[..., :3] - centre) / 0.2, cloud[..., 3:]), dim=2)
    features = made.shared(points).max(dim=1).values
    features.square().sum().backward()
    for mine, weights in zip(short, made.parameters(), strict=True):
        assert_close(mine, weights.grad)
    with torch.no_grad():
        assert_close(made(cloud.flatten(1))[:, :-3], features.detach())


@pytest.mark.parametrize("width", [1, 8, 13])
def test_columns_in_eights_change_no_product(width: int):
    generator = torch.Generator().manual_seed(0)
    x, weight = (torch.randn(rows, width, generator=generator, requires_grad=True) for rows in (5, 3))
    wide_x, wide_weight = products._in_eights(x, weight)
    assert wide_x.shape[1] == wide_weight.shape[1] == -(-width // 8) * 8
    out = wide_x @ wide_weight.T
    torch.testing.assert_close(out, x @ weight.T)
    for got, expected in zip(
        torch.autograd.grad(out.sum(), (x, weight)), torch.autograd.grad((x @ weight.T).sum(), (x, weight)), strict=True
    ):
        torch.testing.assert_close(got, expected)


@pytest.mark.parametrize("tasks", [[1, 0, 1, 1, 1, 0], [0, 0, 1, 1, 1, 1]], ids=["mixed", "in order"])
def test_own_heads_are_those_of_all_heads(tasks):
    generator = torch.Generator().manual_seed(0)
    actor = GaussianActor(TASKS_LAST, (8,), 3, 0.5, generator, heads=2)
    x = torch.randn(6, 5, generator=generator)
    x[:, 3:] = torch.eye(2)[torch.tensor(tasks)]

    def found(own: bool) -> list[Tensor]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(maths, "may_look", lambda device: own)
            out = actor(x)
            return [out, *torch.autograd.grad(out.square().sum(), list(actor.mean.parameters()))]

    for one, other in zip(found(True), found(False), strict=True):
        assert_close(one, other)
    alone = x[1:2]
    assert_close(actor(alone), actor(x)[1:2])


def test_a_target_network_follows_by_a_share_of_the_way():
    target = torch.nn.Linear(1, 1)
    network = torch.nn.Linear(1, 1)
    torch.nn.init.zeros_(target.weight)
    torch.nn.init.ones_(network.weight)
    for expected in (0.1, 0.19):
        follow(target, network, 0.1)
        assert target.weight.item() == pytest.approx(expected) and network.weight.item() == 1.0
